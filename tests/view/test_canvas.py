"""What one browser is sent, and what is taken away again; the browser's handle is a recorder."""

from unittest.mock import MagicMock

import numpy as np

from enact_dist.view.drawing.nodes import AxesNode, FrustumNode, LabelNode, PointsNode
from enact_dist.view.drawing.scene import SceneView
from enact_dist.view.pages.canvas import Canvas


def scene(*nodes):
    """Return a scene of these nodes, each with a frame of its name at the origin."""
    return SceneView(
        {f"{node.frame}/{number}": node for number, node in enumerate(nodes)},
        {node.frame: np.eye(4) for node in nodes},
        (),
    )


def test_a_label_that_reads_and_stands_as_before_is_sent_once():
    """It is made anew for each picture."""
    client = MagicMock()
    canvas = Canvas(client)
    sent = [
        canvas.draw({"": scene(LabelNode("cup", text, np.zeros(3)))})
        for text in ("late", "late", "on time")
    ]
    assert sent == [1, 0, 1]
    assert client.scene.add_label.call_count == 2


def test_frames_of_entities_that_have_gone_are_removed():
    """A cell makes and drops entities all day; nothing of them stays in a page."""
    client = MagicMock()
    client.scene.add_frame.side_effect = lambda *_, **__: MagicMock()
    canvas = Canvas(client)
    for number in range(50):
        canvas.draw({"": scene(AxesNode(f"piece/{number}", np.eye(4)))})
    paths = [call.args[0] for call in client.scene.add_frame.call_args_list]
    assert len(canvas._frames) == len(canvas._drawn) == 1
    assert len(canvas._numbers) == 2
    assert len(set(paths)) == len(paths) == 100


def test_points_of_one_colour_are_moved_and_others_sent_again():
    """Another colour or size, or a colour for each point, makes a new cloud."""
    client = MagicMock()
    canvas, cloud = Canvas(client), client.scene.add_point_cloud
    red, blue, each = (200, 0, 0), (0, 0, 200), np.zeros((7, 3), np.uint8)
    added = []
    for count, colours, size_m in ((5, red, 0.1), (6, red, 0.1), (6, blue, 0.1), (6, blue, 0.2),
                                   (7, each, 0.2), (7, each.copy(), 0.2)):  # fmt: skip
        points_m = np.full((count, 3), count, np.float32)
        assert canvas.draw({"": scene(PointsNode("cell", points_m, colours, size_m))}) == 1
        added.append(cloud.call_count)
    assert added == [1, 1, 2, 3, 4, 5]
    assert cloud.return_value.points.shape == (6, 3)


def test_images_have_as_many_pixels_as_the_page_shows_of_them():
    """A frustum of the size of the scene: far away few are seen, and close to it all."""
    client = MagicMock()
    client.camera.fov, client.camera.image_height = 0.8, 850
    canvas = Canvas(client)
    canvas.draw({"": scene(FrustumNode("camera/1", 1.0, 4 / 3, None, (0, 0, 0)))})
    sides = []
    for away_m in (10.0, 0.8, 0.4, 0.0):
        client.camera.position = (away_m, 0.0, 0.0)
        sides.append(canvas.sides_px()["camera/1"])
    assert sides == [160, 320, 640, 640]
