"""Selecting Gaussians on the screen, by a rectangle, a lasso of clicks or a brush, to delete them."""

import math
import threading
from collections.abc import Callable
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import viser
from jaxtyping import Bool, Int64

from warpgs.editing.contribution import blend_weights_in
from warpgs.editing.marked import Marked
from warpgs.errors import counted
from warpgs.runs.trained import TrainedScene

from . import marks
from .cleanup_controls import BRUSH, LASSO, RADII, RECTANGLE
from .marks import Area, Marks, Point
from .panel import Panel, clamped
from .renderer import RenderRequest

MODIFIERS: tuple[Literal["cmd/ctrl"] | None, ...] = (None, "cmd/ctrl")
"""Keys that are held: none adds to the selection, Ctrl or Cmd removes from it."""

CLOSE_PIXELS = 12.0
"""Largest distance of a click from the first corner that closes a lasso [px]."""

MAX_CORNERS = 500

MIN_WEIGHT = 0.1
"""Smallest blend weight in the image of a Gaussian that is seen [px]."""


@runtime_checkable
class Editor(Protocol):
    """What edits the scene."""

    @property
    def whole(self) -> TrainedScene | None:
        """The scene without edits; None if it cannot be edited."""

    def say(self, text: str) -> None:
        """Shows a line."""


class Selection:
    """What is selected in one browser.

    Args:
        scene: Scene of the browser, which tells of clicks.
        panel: Its controls.
        editor: What edits the scene.
        request: The image that the browser asks for; None before there is a scene.
        rendering: Lock of ``Renderer``.

    Attributes:
        selected: Gaussians of the scene without edits; None if there are none.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        panel: Panel,
        editor: Editor,
        request: Callable[[], RenderRequest | None],
        rendering: threading.Lock,
    ) -> None:
        self._scene, self._editor, self._request = scene, editor, request
        self._controls, self._rendering, self._lock = panel.cleanup, rendering, threading.Lock()
        self._corners: list[Point] = []
        self.selected: Marked | None = None
        self._controls.tool.on_update(lambda _: self._take_up())

    @property
    def marks(self) -> Marks:
        """What is drawn of it."""
        return Marks(self.selected, tuple(self._corners))

    def clear(self) -> None:
        """Selects nothing."""
        self.selected, self._corners = None, []

    def invert(self) -> None:
        """Selects what is shown and not selected."""
        with self._lock:
            request, mask = self._request(), self._mask()
            if request is not None and mask is not None:
                rows = _rows(request.scene, mask)
                inverse = np.zeros_like(mask)
                inverse[rows] = ~mask[rows]
                self._set(inverse)

    def _take_up(self) -> None:
        """Listens for what the tool needs, and no longer for what the one before needed."""
        tool, scene = self._controls.tool.value, self._scene
        self._corners = []
        scene.remove_click_callback()
        scene.remove_rect_select_callback()
        self._controls.radius.visible = tool == BRUSH
        for modifier in MODIFIERS:
            if tool == RECTANGLE:
                scene.on_rect_select(modifier=modifier)(self._drag)
            elif tool in (LASSO, BRUSH):
                scene.on_click(modifier=modifier)(self._click)

    def _drag(self, event: Any) -> None:
        """Selects in a rectangle."""
        low, high = _point(event.screen_min), _point(event.screen_max)
        if low is not None and high is not None:
            corners = [low, (high[0], low[1]), high, (low[0], high[1])]
            self._select(lambda size: marks.polygon(size, corners), event.modifier)

    def _click(self, event: Any) -> None:
        """Selects around a click, or makes it a corner of a lasso."""
        point = _point(event.screen_pos)
        if point is None:
            return
        if self._controls.tool.value == BRUSH:
            radius = clamped(self._controls.radius.value, RADII)
            self._select(lambda size: marks.disc(size, point, radius), event.modifier)
            return
        with self._lock:
            corners, request = self._corners, self._request()
            if request is None:
                return
            ends = np.multiply((corners[0] if corners else point, point), request.canvas)
            is_near = math.dist(*ends) < CLOSE_PIXELS
            is_closed = is_near and len(corners) > 2
            self._corners = [] if is_closed else [*corners, point][:MAX_CORNERS]
        if is_closed:
            self._select(lambda size: marks.polygon(size, corners), event.modifier)
        else:
            self._editor.say(f"lasso of {counted(len(self._corners), 'corner')}: click at the first one to close it")

    def _select(self, area_of: Callable[[tuple[int, int]], Area], modifier: str | None) -> None:
        """Adds the shown Gaussians in an area of the image to the selection, or removes them from it."""
        with self._lock:
            request, mask = self._request(), self._mask()
            if request is None or mask is None:
                return
            scene, camera = request.scene, request.seen
            with self._rendering:
                splats = scene.splats(camera.time)
                hit = marks.inside(splats, camera, area_of(camera.size))
                if self._controls.seen.value:
                    weights = blend_weights_in(splats, camera.to(scene.device), scene.config.render_settings)
                    hit &= weights >= MIN_WEIGHT
            if request.layer in ("static", "dynamic"):
                assert splats.is_dynamic is not None
                hit &= splats.is_dynamic == (request.layer == "dynamic")
            mask[_rows(scene, mask)[hit.cpu().numpy()]] = modifier is None
            self._set(mask)

    def _mask(self) -> Bool[np.ndarray, " N"] | None:
        """What is selected, of the Gaussians of the scene without edits; None if it cannot be edited."""
        if self.selected is not None:
            return self.selected.mask
        whole = self._editor.whole
        return None if whole is None else np.zeros(len(whole.scene.static) + len(whole.scene.dynamic), bool)

    def _set(self, mask: Bool[np.ndarray, " N"]) -> None:
        self.selected = Marked.of(mask) if mask.any() else None
        self._editor.say(f"{int(mask.sum()):,} of {len(mask):,} Gaussians are selected")


def _rows(scene: TrainedScene, mask: Bool[np.ndarray, " N"]) -> Int64[np.ndarray, " M"]:
    """The rows of a scene's Gaussians in a mask over the scene without edits."""
    return np.arange(len(mask)) if scene.rows is None else scene.rows.cpu().numpy()


def _point(position: Any) -> Point | None:
    """A position on the screen that a browser sent; None if it has none."""
    try:
        x, y = (float(value) for value in position)
    except (TypeError, ValueError):
        return None
    return (min(max(x, 0.0), 1.0), min(max(y, 0.0), 1.0)) if math.isfinite(x) and math.isfinite(y) else None
