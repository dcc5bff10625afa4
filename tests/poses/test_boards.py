"""Boards: positions against the authors' published formulas, and codes against OpenCV's."""

import numpy as np
import pytest

from nerfro.poses.boards import draw_tag, tag_grid, twelve_faces


def test_board_positions_match_the_authors() -> None:
    corners = twelve_faces().tag_corners()
    assert sorted(corners) == list(range(108))
    # Face, tag within it, and the place of its cell by calib_camera_with_apriltag.py; 2 to 7 modules from its sides.
    j, i = 1, 2
    down, right = np.array([0.2, 0.2, 0.7, 0.7]) / 10, np.array([0.2, 0.7, 0.7, 0.2]) / 10
    flat = np.zeros(4)
    cases = {
        0: (0.09 * j + down, 0.18 + right, flat),
        3: (0.54 + 0.09 * j + down, 0.27 + 0.18 + right, flat),
        7: (0.09 * j + down, 0.27 + 0.18 + right, flat),
        8: (flat + 0.54, 0.27 + 0.18 + right, 0.27 - 0.09 * j - down),
        9: (0.54 - 0.18 - right, flat + 0.54, 0.27 - 0.09 * j - down),
        10: (flat + 0.27, 0.54 - 0.18 - right, 0.27 - 0.09 * j - down),
        11: (0.27 + 0.18 + right, flat + 0.27, 0.27 - 0.09 * j - down),
    }
    for face, expected in cases.items():
        np.testing.assert_allclose(corners[9 * face + j + 3 * i], np.stack(expected, 1), atol=1e-12)


def test_tags_match_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    pytest.importorskip("pyapriltags")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for number in (0, 5, 586):
        tag = draw_tag("tag36h11", number)
        assert (tag[[0, -1]] == 255).all()
        # OpenCV turns them upside down.
        theirs = cv2.aruco.generateImageMarker(dictionary, number, 8)
        np.testing.assert_array_equal(tag[1:-1, 1:-1], np.rot90(theirs, 2))


def test_detected_corners_match_the_drawing() -> None:
    cv2 = pytest.importorskip("cv2")
    pytest.importorskip("pyapriltags")
    for board in (twelve_faces(), tag_grid(3, 4, 0.05)):
        face = board.faces[-1]
        drawn = np.pad(board.draw(face, 12), 36, constant_values=255)
        found = board.detect(cv2.GaussianBlur(drawn, (0, 0), 1.0))
        assert sorted(set(found.tag_ids)) == sorted(face.ids.ravel())
        offset = found.board_points - np.array(face.origin)
        expected = 36 + 12 * np.stack([offset @ face.right, offset @ face.down], 1) / board.module
        np.testing.assert_allclose(found.image_points, expected, atol=0.5)
