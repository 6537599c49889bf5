"""The picture of the assembly: what is nearest is seen, whole, in its own colour."""

import io

import numpy as np
from PIL import Image

from morph_core.picture import Camera, draw, png

WIDTH, HEIGHT = 720, 540
FROM_THE_SIDE = np.array([0.75, -0.95, 0.5])
FAN = np.linspace(0, 2 * np.pi, 400)


def disc(height: float) -> np.ndarray:
    """Return a disc of slender triangles (F, 3, 3) that all meet in its middle, seen from above."""
    rim = np.stack([np.cos(FAN), np.sin(FAN), np.full(len(FAN), height)], 1)
    middle = np.full((len(FAN) - 1, 3), [0, 0, height])
    return np.stack([middle, rim[:-1], rim[1:]], 1)


def painted(*surfaces: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the picture (height, width, 4)."""
    points = np.concatenate([triangles.reshape(-1, 3) for triangles, _ in surfaces])
    image = png(draw(surfaces, Camera.framing(points, FROM_THE_SIDE, WIDTH, HEIGHT)))
    return np.array(Image.open(io.BytesIO(image)))


def test_slender_triangles_leave_no_gaps() -> None:
    image = painted((disc(0.0), np.array([1.0, 0.0, 0.0])))
    assert image.shape == (HEIGHT, WIDTH, 4)
    covered = image[..., 3] == 255
    for row in covered[covered.any(1)]:
        first, last = np.flatnonzero(row)[[0, -1]]
        assert row[first : last + 1].all()
    assert covered.mean() > 0.2
    assert image[0, 0, 3] == 0  # the ground is transparent


def test_the_nearest_surface_hides_the_others() -> None:
    red, blue = (disc(1.0), np.array([1.0, 0.0, 0.0])), (disc(0.0), np.array([0.0, 0.0, 1.0]))
    for surfaces in ((red, blue), (blue, red)):
        image = painted(*surfaces).astype(int)
        solid = image[image[..., 3] == 255]
        assert (solid[:, 0] > 50).mean() > 0.4  # all of the upper one
        seen = image[:, WIDTH // 2]
        assert seen[seen[:, 3] == 255][0, 0] > 50  # and it is above


def test_from_above_only_the_upper_of_two_discs_is_seen() -> None:
    red, blue = (disc(1.0), np.array([1.0, 0.0, 0.0])), (disc(0.0), np.array([0.0, 0.0, 1.0]))
    camera = Camera.framing(disc(0.0).reshape(-1, 3), np.array([0.0, 0, 1]), 40, 40)
    for surfaces in ([red, blue], [blue, red]):
        image = draw(surfaces, camera)
        assert not image[..., 2].any()
        assert (image[..., 0] > 50).mean() > 0.5


def test_a_surface_seen_from_behind_is_not_drawn() -> None:
    back = disc(0.0)[:, ::-1]
    image = painted((back, np.array([1.0, 0.0, 0.0])), (disc(-3.0), np.array([0.0, 1.0, 0.0])))
    assert not image[..., 0].any()


def test_what_reaches_beyond_the_picture_is_cut_off() -> None:
    high, wide = np.array([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]]), np.array([[-1.0, -1, 0], [1, 1, 0]])
    camera = Camera.framing(wide, np.array([0.0, 0, 1]), 40, 30)
    image = draw([(high[None], np.array([1.0, 0, 0]))], camera)
    assert image.shape == (30, 40, 4)
    assert (image[..., 3] == 255).all()
    beside = draw([(high[None] + [30, 0, 0], np.array([1.0, 0, 0])), (high[None] - [0, 0, 9], np.zeros(3))], camera)
    assert not beside[..., 0].any()


def test_the_same_pixels_come_back_from_a_png() -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 4), dtype=np.uint8)
    assert np.array_equal(np.array(Image.open(io.BytesIO(png(image)))), image)
