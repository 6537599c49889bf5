"""Small pictures of designs, drawn without a browser or a display, and kept as long as there is room."""

import threading
from collections import OrderedDict

import msgspec
import numpy as np

from morph_core.catalogue import make_task
from morph_core.picture import png

WIDTH, HEIGHT = 192, 144
"""Pixels; the page shows half as many, which are sharp on a screen of twice the density."""
MOST_BYTES = 16 << 20
"""Largest size of all pictures that are kept; each has a few thousand bytes."""


class Thumbnails:
    """Pictures of designs in their start posture. It is thread-safe and draws one at a time."""

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        self._most_bytes = most_bytes
        self._lock = threading.Lock()
        self._kept: OrderedDict[bytes, bytes] = OrderedDict()  # least recently used first
        self._size = 0

    def of(self, task: str, task_options: dict[str, object], phi: list[float]) -> bytes:
        """Return a PNG of a design on a clear ground. Raise ValueError if it can't be built."""
        key = msgspec.json.encode((task, sorted(task_options.items()), phi))
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
            drawn = draw_thumbnail(task, task_options, phi)
            self._kept[key], self._size = drawn, self._size + len(drawn)
            while self._size > self._most_bytes:
                _, oldest = self._kept.popitem(last=False)
                self._size -= len(oldest)
            return drawn


def draw_thumbnail(task_name: str, task_options: dict[str, object], phi: list[float]) -> bytes:
    """Return a PNG of a design. Raise ValueError if there is no such task, or the design can't be built."""
    from morph_core.envs.view import View  # with it comes Gymnasium, which a server needs for nothing else

    try:
        task = make_task(task_name, task_options)
    except TypeError as error:
        raise ValueError(f"an option of {task_name[:40]} has the wrong type: {error}") from error
    design = task.design_space.check(phi)
    hw_phy = task.hw_phy(design)
    start = task.reset(hw_phy, 1, np.random.default_rng(0))[0]
    return png(_widened(View(task, design, hw_phy, WIDTH, HEIGHT).on_clear_ground(start)))


def _widened(image: np.ndarray) -> np.ndarray:
    """Return an image (h, w, 4) whose shapes are a pixel wider on each side: at this size an arm of metres is a thread.

    A pixel takes the colour of the most opaque one among itself and its four neighbours.
    """
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    near = np.stack([image, padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]])
    return np.take_along_axis(near, near[..., 3].argmax(0)[None, ..., None], 0)[0]
