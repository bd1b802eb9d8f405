"""Finish pictures: depth images in grey, labels, tiles, bars, PNG.

Pictures are RGB, uint8, (H, W, 3).  The font is OpenCV's, drawn large and averaged: no font file is
needed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    Picture = npt.NDArray[np.uint8]

INK: Final = (38, 44, 52)
PAPER: Final = (255, 255, 255)
ALARM: Final = (226, 61, 40)
GOOD: Final = (22, 163, 102)
BACKDROP: Final = (244, 246, 248)
GAP_PX: Final = 12
CAPTION_PX: Final = 34


def depth_picture(depth_mm: npt.NDArray[np.uint16]) -> Picture:
    """Show a depth image in grey, near is light, unknown is a pale hatch.

    Args:
        depth_mm: (H, W), 0 where unknown.
    """
    known = depth_mm > 0
    picture = np.full((*depth_mm.shape, 3), 236, np.uint8)
    if known.any():
        near, far = np.quantile(depth_mm[known], (0.01, 0.99))
        share = np.clip((depth_mm - near) / max(far - near, 1.0), 0.0, 1.0)
        grey = np.rint(225.0 - 165.0 * share).astype(np.uint8)
        picture[known] = grey[known][:, None]
    rows, columns = np.indices(depth_mm.shape)
    hatch = ((rows + columns) // 2 % 5 == 0) & ~known
    picture[hatch] = 205
    return picture


def with_label(
    picture: Picture,
    text: str,
    at_px: tuple[int, int],
    *,
    height_px: int = 15,
    colour: tuple[int, int, int] = INK,
    paper: tuple[int, int, int] | None = PAPER,
) -> Picture:
    """Write a line of text into a picture.

    Args:
        picture: (H, W, 3).
        text: One line; characters beyond ASCII are replaced (°, ², ± by words).
        at_px: Column and row of the upper left corner.
        height_px: Height of a capital letter with its margins.
        colour: RGB of the letters.
        paper: RGB of a half-transparent plate behind the letters; None for none.
    """
    patch, cover = _lettering(text, height_px)
    left, top = max(0, at_px[0]), max(0, at_px[1])
    result = picture.copy()
    area = result[top : top + patch.shape[0], left : left + patch.shape[1]].astype(np.float32)
    cover = cover[: area.shape[0], : area.shape[1], None]
    if paper is not None:
        area += 0.78 * (np.array(paper, np.float32) - area)
    area += cover * (np.array(colour, np.float32) - area)
    result[top : top + area.shape[0], left : left + area.shape[1]] = np.rint(area)
    return result


def tiles(
    pictures: Sequence[Picture], captions: Sequence[str] | None = None, *, columns: int = 2
) -> Picture:
    """Lay pictures side by side on white, each under its caption.

    Args:
        pictures: At least one; smaller ones are centred in their tile.
        captions: One line for each, or none.
        columns: Tiles in a row.
    """
    lines = list(captions) if captions is not None else [""] * len(pictures)
    head = CAPTION_PX if captions is not None else 0
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    height = max(picture.shape[0] for picture in pictures)
    width = max(picture.shape[1] for picture in pictures)
    sheet = np.full(
        (
            rows * (height + head) + (rows + 1) * GAP_PX,
            columns * width + (columns + 1) * GAP_PX,
            3,
        ),
        255,
        np.uint8,
    )
    for number, (picture, line) in enumerate(zip(pictures, lines, strict=True)):
        row, column = divmod(number, columns)
        top = GAP_PX + row * (height + head + GAP_PX)
        left = GAP_PX + column * (width + GAP_PX)
        if line:
            sheet = with_label(sheet, line, (left, top), height_px=20, paper=None)
        down = top + head + (height - picture.shape[0]) // 2
        right = left + (width - picture.shape[1]) // 2
        sheet[down : down + picture.shape[0], right : right + picture.shape[1]] = picture
    return sheet


def bars(
    rows: Sequence[tuple[str, float]], *, size_px: tuple[int, int], threshold: float | None = None
) -> Picture:
    """Draw a horizontal bar for each value between 0 and 1, the first one in green.

    Args:
        rows: Label and value, best first.
        size_px: Width and height; rows that do not fit are left out.
        threshold: A value marked by an upright line.
    """
    import cv2

    width, height = size_px
    sheet = np.full((height, width, 3), BACKDROP, np.uint8)
    left, right, step = int(0.34 * width), int(0.88 * width), 46
    for number, (label, value) in enumerate(rows[: max(1, (height - 40) // step)]):
        top = 24 + number * step
        end = left + round((right - left) * float(np.clip(value, 0.0, 1.0)))
        colour = GOOD if number == 0 else (168, 178, 190)
        cv2.rectangle(sheet, (left, top), (right, top + 24), (226, 230, 235), cv2.FILLED)
        cv2.rectangle(sheet, (left, top), (end, top + 24), colour, cv2.FILLED)
        sheet = with_label(sheet, label, (12, top - 1), height_px=17, paper=None)
        sheet = with_label(sheet, f"{value:.2f}", (right + 4, top - 1), height_px=17, paper=None)
        if threshold is not None:
            mark = left + round((right - left) * threshold)
            cv2.line(sheet, (mark, top - 4), (mark, top + 28), ALARM, 1, cv2.LINE_AA)
    return sheet


def png_bytes(picture: Picture) -> bytes:
    """Encode a picture as PNG."""
    import cv2

    done, content = cv2.imencode(".png", np.ascontiguousarray(picture[:, :, ::-1]))
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} and {picture.dtype} is no PNG")
    return bytes(content)


def _lettering(text: str, height_px: int) -> tuple[npt.NDArray[np.uint8], Any]:
    """Return a plate of the text's size and how much ink covers each pixel, 0 … 1."""
    import cv2

    for sign, word in (("°", " deg"), ("²", "2"), ("±", "+-"), ("…", "...")):
        text = text.replace(sign, word)
    text = text.encode("ascii", "replace").decode("ascii")
    font, over = cv2.FONT_HERSHEY_SIMPLEX, 4
    scale = over * height_px / 34.0
    (width, height), below = cv2.getTextSize(text, font, scale, over + 1)
    margin = over * 5
    large = np.zeros((height + below + 2 * margin, width + 2 * margin), np.uint8)
    cv2.putText(large, text, (margin, margin + height), font, scale, 255, over + 1, cv2.LINE_AA)
    size = (max(1, large.shape[1] // over), max(1, large.shape[0] // over))
    cover = cv2.resize(large, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
    return np.zeros((*cover.shape, 3), np.uint8), cover
