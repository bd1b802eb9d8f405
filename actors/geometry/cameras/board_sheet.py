"""A ChArUco board as a sheet to print: PNG, SVG or PDF, at its true size.

Black rectangles on white paper, the same in all three, and a line of text that says what it is.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.pictures.picture import png_bytes

if TYPE_CHECKING:
    from collections.abc import Iterator

    from actors.geometry.cameras.charuco import Board

KINDS: Final = (".png", ".svg", ".pdf")
DOTS_PER_INCH: Final = 300
MARGIN_M: Final = 0.01
"""White around the squares; detection needs some."""
TEXT_M: Final = 0.004
"""Height of the line of text, in the lower margin."""
_POINTS_PER_M: Final = 72.0 / 0.0254


def sheet(board: Board, kind: str) -> bytes:
    """Return a board to print.

    Args:
        board: The board.
        kind: One of `KINDS`.
    """
    return {".png": _png, ".svg": _svg, ".pdf": _pdf}[kind](board)


def rectangles(board: Board) -> Iterator[tuple[float, float, float, float]]:
    """Yield what is black: left, bottom, width and height, metres, in the frame of the board."""
    white = {
        (int(x // board.square_m), int(y // board.square_m))
        for x, y, _ in board.marker_corners_m.mean(axis=1)
    }
    for column in range(board.columns):
        for row in range(board.rows):
            if (column, row) not in white:
                yield (
                    column * board.square_m, row * board.square_m, board.square_m, board.square_m
                )  # fmt: skip
    for number, corners_m in enumerate(board.marker_corners_m):
        bits = board.marker_bits(number)
        edge_m = board.marker_m / len(bits)
        left, top, _ = corners_m[0]
        for down, line in enumerate(bits):
            black = np.flatnonzero(np.diff(np.concatenate(([0], line.astype(int), [0]))))
            for begin, end in black.reshape(-1, 2):
                width_m = float(end - begin) * edge_m
                yield (
                    float(left + begin * edge_m),
                    float(top - (down + 1) * edge_m),
                    width_m,
                    edge_m,
                )


def _text(board: Board) -> str:
    return f"--board {board}   a square is {1e3 * board.square_m:g} mm: measure it"


def _svg(board: Board) -> bytes:
    wide, high = (1e3 * (edge + 2.0 * MARGIN_M) for edge in (board.width_m, board.height_m))
    margin = 1e3 * MARGIN_M
    parts = []
    for left, bottom, width, height in rectangles(board):
        top = board.height_m - bottom - height
        x, y, w, h = (1e3 * value for value in (left, top, width, height))
        parts.append(
            f'<rect x="{margin + x:.4f}" y="{margin + y:.4f}" width="{w:.4f}" height="{h:.4f}"/>'
        )
    line = (
        f'<text x="{margin}" y="{high - 3.0:.4f}" font-size="{1e3 * TEXT_M}">{_text(board)}</text>'
    )
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{wide:g}mm" height="{high:g}mm"'
        f' viewBox="0 0 {wide:g} {high:g}" shape-rendering="crispEdges" font-family="sans-serif">'
        f'<rect width="{wide:g}" height="{high:g}" fill="white"/>'
    )
    return "\n".join([head, *parts, line, "</svg>", ""]).encode()


def _pdf(board: Board) -> bytes:
    wide, high = (
        _POINTS_PER_M * (edge + 2.0 * MARGIN_M) for edge in (board.width_m, board.height_m)
    )
    lines = []
    for left, bottom, width, height in rectangles(board):
        x, y = (_POINTS_PER_M * (value + MARGIN_M) for value in (left, bottom))
        lines.append(f"{x:.4f} {y:.4f} {_POINTS_PER_M * width:.4f} {_POINTS_PER_M * height:.4f} re")
    size, at = _POINTS_PER_M * TEXT_M, _POINTS_PER_M * MARGIN_M
    text = f"BT /F1 {size:.2f} Tf {at:.2f} {_POINTS_PER_M * 0.003:.2f} Td ({_text(board)}) Tj ET"
    drawing = "\n".join([*lines, "f", text]).encode()
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {wide:.4f} {high:.4f}] /Contents 4 0 R"
        " /Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(drawing), drawing),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out, places = bytearray(b"%PDF-1.4\n"), []
    for number, content in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, content)
    table = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % place for place in places)
    out += b"trailer << /Size %d /Root 1 0 R >>\n" % (len(objects) + 1)
    return bytes(out + b"startxref\n%d\n%%%%EOF\n" % table)


def _png(board: Board) -> bytes:
    import cv2

    per_m = DOTS_PER_INCH / 0.0254
    wide, high = (
        round(per_m * (edge + 2.0 * MARGIN_M)) for edge in (board.width_m, board.height_m)
    )
    picture = np.full((high, wide, 3), 255, np.uint8)
    for left, bottom, width, height in rectangles(board):
        edges = np.array(
            [left, left + width, board.height_m - bottom - height, board.height_m - bottom]
        )
        x0, x1, y0, y1 = np.rint(per_m * (edges + MARGIN_M)).astype(int)
        picture[y0:y1, x0:x1] = 0
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, per_m * TEXT_M / 30.0
    at = (round(per_m * MARGIN_M), high - round(per_m * 0.003))
    cv2.putText(picture, _text(board), at, font, scale, (0, 0, 0), 2, cv2.LINE_AA)
    data = png_bytes(picture)
    size = struct.pack(">IIB", round(per_m), round(per_m), 1)  # dots per metre
    check = struct.pack(">I", zlib.crc32(b"pHYs" + size))
    header = 33  # signature (8) and IHDR (25)
    return data[:header] + struct.pack(">I", len(size)) + b"pHYs" + size + check + data[header:]
