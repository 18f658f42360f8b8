"""Edits in the browser: a crop box with two corners to drag, opacity, floaters, undo; saved as the file of edits."""

import threading
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import viser
from jaxtyping import Float32

from warpgs.editing.edits_file import check, names_of
from warpgs.editing.marked import Marked
from warpgs.editing.options import Box, Edits, split_names
from warpgs.errors import one_line
from warpgs.runs.trained import TrainedScene

from .cleanup_controls import (
    CLEAR,
    CORNERS,
    DELETE,
    FREEZE,
    INVERT,
    ONLY,
    OPACITIES,
    RECOLOR,
    REMOVE,
    RESET,
    SHIFT,
    SHIFTS,
)
from .panel import Panel, clamped, set_value
from .path_controls import note_html
from .renderer import RenderRequest
from .selection import Selection
from .source import Source

BOX = "/crop"
"""Path of the box in the scene of the browser."""

COLOR = (255, 160, 60)
LINE_PIXELS = 1.5

HANDLE_SIZE = 0.15
"""Size of the arrows of a corner, relative to the diagonal of the box."""

QUANTILES = (0.01, 0.99)
"""Of the Gaussians' centres, along each axis: where a new box begins and ends."""

NO_OBJECTS = "objects are found in finished runs: open one without --while-training, and no sequence of files"

DIGITS = 3
"""Decimals of the positions of its corners."""

MAX_UNDO = 100
"""Maximum number of edits that can be undone."""


class Cleanup:
    """The edits of one browser.

    Args:
        scene: Scene of the browser, for the box.
        panel: Its controls.
        source: The scene that is edited, and its edits so far.
        rendering: Lock of ``Renderer``, held while contributions are measured.
        wake: Called after a change.
        request: The image that the browser asks for.

    Attributes:
        edits: The edits in use.
        selection: What is selected to be deleted.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        panel: Panel,
        source: Source,
        rendering: threading.Lock,
        wake: Callable[[], None],
        request: Callable[[], RenderRequest | None],
    ) -> None:
        controls = panel.cleanup
        self._scene, self._panel, self._controls, self._source = scene, panel, controls, source
        self._rendering, self._wake, self._lock = rendering, wake, threading.RLock()
        self._before: list[Edits] = []
        self._last = ""  # name of the edit that was changed last
        self._handles: list[Any] = []
        self._is_setting = False
        self._shown: tuple[Edits, TrainedScene, TrainedScene] | None = None  # edits, the scene without and with them
        shown = source.current()
        self._can_edit = not source.follow and shown is not None and not shown.varies
        for control in (
            controls.crop,
            controls.opacity,
            controls.floaters,
            controls.tool,
            controls.undo,
            controls.save,
        ):
            control.disabled = not self._can_edit
        controls.copy.disabled = not (self._can_edit and source.can_copy)
        self.selection = Selection(scene, panel, self, request, rendering)
        self._show_objects()
        self.edits = source.edits
        self._set_controls()
        self._connect()

    def _connect(self) -> None:
        controls, panel = self._controls, self._panel
        controls.crop.on_update(lambda _: self._crop())
        for corner in controls.corners:
            corner.on_update(lambda _: self._type())
        controls.opacity.on_update(
            lambda _: self._change("min_opacity", clamped(controls.opacity.value, OPACITIES) or None)
        )
        controls.floaters.on_update(lambda _: self._change("drop_floaters", bool(controls.floaters.value) or None))
        controls.find.on_click(lambda _: self.find_objects())
        panel.layer.on_update(lambda _: self.find_objects() if panel.current_layer == "objects" else None)
        controls.choice.on_click(lambda _: self._choose(controls.object.value, controls.choice.value))
        controls.change.on_click(lambda _: self._choose(controls.object.value, controls.change.value))
        controls.selected.on_click(lambda _: self._use_selection(controls.selected.value))
        controls.copy.on_click(lambda _: self._copy())
        controls.undo.on_click(lambda _: self._undo())
        controls.save.on_click(lambda _: self._save())

    @property
    def whole(self) -> TrainedScene | None:
        """The scene without edits; None if it cannot be edited."""
        return self._source.current() if self._can_edit else None

    def say(self, text: str) -> None:
        """Shows a line about what was selected."""
        self._note(text)
        self._wake()

    def scene(self) -> TrainedScene | None:
        """The scene to show; None before the first checkpoint of a training. Edits that leave nothing are undone."""
        scene, edits = self._source.current(), self.edits
        if scene is None or not self._can_edit:
            return scene
        shown = self._shown
        if shown is None or shown[0] != edits or shown[1] is not scene:
            if shown is None or shown[1] is not scene:  # another browser may have found objects
                self._show_objects()
            try:
                with self._rendering:
                    shown = self._shown = edits, scene, self._source.edited(edits)
            except ValueError as error:
                self._refuse(edits, one_line(error))
                return scene if shown is None else shown[2]
        return shown[2]

    def find_objects(self) -> None:
        """Finds objects, for all browsers, unless they are known."""
        if not self._source.can_find_objects:
            if not self._can_edit:
                self._note(NO_OBJECTS)
            return
        self._note("finding objects")
        try:
            with self._rendering:
                notes = self._source.find_objects()
            self._note("; ".join(notes))
        except ValueError as error:
            self._note(one_line(error))
        self._wake()

    def _show_objects(self) -> None:
        """Offers the objects that were found, or to find them."""
        controls = self._controls
        self._objects = self._source.object_names
        if self._objects:
            controls.object.options = self._objects
        for control in (controls.object, controls.choice, controls.change, controls.color, controls.shift):
            control.visible = bool(self._objects)
        controls.find.visible = self._source.can_find_objects

    def restore(self, edits: Edits) -> None:
        """Makes the edits of a page that was reloaded."""
        with self._lock:
            self.edits = edits
            self._set_controls()

    def _change(self, name: str, value: Any, **others: Any) -> None:
        """Replaces edits; changes of one slider are one step of undo."""
        with self._lock:
            changed = replace(self.edits, **{name: value}, **others)
            if self._is_setting or not self._can_edit or changed == self.edits:
                return
            try:
                check(changed)
            except ValueError as error:  # a browser may send anything
                self._set_controls()
                self._note(str(error))
                return
            if name != self._last or name != "min_opacity":
                self._before = [*self._before, self.edits][-MAX_UNDO:]
            self.edits, self._last = changed, name
            self._set_controls()
        self._wake()

    def _choose(self, name: str, choice: str) -> None:
        """Shows an object alone, removes or changes it, or shows it as it was trained."""
        if name not in self._objects:
            return
        edits, controls = self.edits, self._controls
        recolored, frozen, shifted = (
            tuple(row for row in rows if row[0] != name) for rows in (edits.recolor, edits.freeze, edits.shift)
        )
        if choice == ONLY:
            self._change("objects", name)
        elif choice == REMOVE:
            self._change("remove", name if self.edits.remove is None else f"{self.edits.remove},{name}")
        elif choice == FREEZE:
            self._change("freeze", (*frozen, (name, self._panel.current_time)), shift=shifted)
        elif choice == SHIFT:
            self._change("shift", (*shifted, (name, clamped(controls.shift.value, SHIFTS))), freeze=frozen)
        elif choice == RECOLOR:
            red, green, blue = (clamped(value, (0, 255)) / 255 for value in controls.color.value)
            self._change("recolor", (*recolored, (name, red, green, blue)))
        elif choice == RESET:
            removed = [other for other in split_names(edits.remove) if other != name]
            self._change("recolor", recolored, freeze=frozen, shift=shifted, remove=",".join(removed) or None)

    def _use_selection(self, choice: str) -> None:
        """Deletes what is selected, selects the rest instead, or nothing."""
        selection = self.selection
        if choice == DELETE and selection.selected is not None:
            erased, before = selection.selected.mask, self.edits.erased
            self._change("erased", Marked.of(erased if before is None else erased | before.mask))
        if choice == INVERT:
            selection.invert()
        elif choice in (DELETE, CLEAR):
            selection.clear()
        self._wake()

    def _undo(self) -> None:
        with self._lock:
            self.edits = self._before.pop() if self._before else self._source.edits
            self._last = ""
            self._set_controls()
        self._wake()

    def _refuse(self, refused: Edits, reason: str) -> None:
        """Undoes edits that cannot be made; those that were made while they were tried stay, to be tried next."""
        with self._lock:
            self._before = [edits for edits in self._before if edits != refused]
            if self.edits == refused:
                self._undo()
            self._note(reason)
        self._wake()

    def _save(self) -> None:
        if not self._can_edit:
            return
        try:
            with self._rendering:
                path = self._source.save(self.edits)
            self._note(f"saved as {path.name}")
        except (ValueError, OSError) as error:
            self._note(one_line(error))

    def _copy(self) -> None:
        """Saves the edits in a copy of the run."""
        try:
            edits = self.edits
            with self._rendering:
                self._source.edited(edits)
            folder = self._source.copy(str(self._controls.name.value), edits)  # meanwhile, browsers see images
            self._note(f"saved as {folder.name}, beside this run")
        except (ValueError, OSError) as error:
            self._note(one_line(error))

    def _crop(self) -> None:
        """Shows a box around most of the scene, or none."""
        if not self._controls.crop.value:
            self._change("crop", None)
        elif self.edits.crop is None and (scene := self._source.current()) is not None:
            means = scene.splats(0.5).means.cpu().numpy()
            low, high = np.nanquantile(means, QUANTILES, axis=0).round(DIGITS)
            self._change("crop", _box(low, high))

    def _type(self) -> None:
        """Makes the box between the corners that were typed."""
        with self._lock:  # while both are set, one is not yet what it will be
            if self.edits.crop is not None and not self._is_setting:
                self._change("crop", _box(*(corner.value for corner in self._controls.corners)))

    def _set_controls(self) -> None:
        """Shows the edits in the controls, and the box in the scene."""
        controls, edits = self._controls, self.edits
        self._is_setting = True
        set_value(controls.crop, edits.crop is not None)
        for k, corner in enumerate(controls.corners):
            corner.visible = edits.crop is not None
            if edits.crop is not None:
                set_value(corner, edits.crop[3 * k : 3 * k + 3])
        set_value(controls.opacity, edits.min_opacity or 0.0)
        set_value(controls.floaters, bool(edits.drop_floaters))
        self._is_setting = False
        self._note(", ".join(names_of(edits)) or "no edits")
        self._show_box(edits.crop)

    def _show_box(self, box: Box | None) -> None:
        if box is None:
            self._scene.remove_by_name(BOX)
            self._handles = []
            return
        corners = np.array(box).reshape(2, 3)
        if not self._handles:
            size = HANDLE_SIZE * float(np.linalg.norm(corners[1] - corners[0]))
            self._handles = [self._corner(name, size) for name in CORNERS]
        for handle, corner in zip(self._handles, corners, strict=True):
            handle.position = corner
        self._draw()

    def _corner(self, name: str, size: float) -> Any:
        """Arrows to drag a corner by."""
        handle = self._scene.add_transform_controls(f"{BOX}/{name}", size, disable_rotations=True, depth_test=False)
        handle.on_update(lambda _: self._draw())
        handle.on_drag_end(lambda _: self._change("crop", _box(*(corner.position for corner in self._handles))))
        return handle

    def _draw(self) -> None:
        """Draws the edges of the box."""
        if self._handles:
            edges = box_edges(*(np.array(handle.position, np.float32) for handle in self._handles))
            name = f"{BOX}/edges"
            self._scene.add_line_segments(name, edges, COLOR, thickness=LINE_PIXELS, thickness_units="screen")

    def _note(self, text: str) -> None:
        self._controls.note.content = note_html(text)


def _box(low: Iterable[float], high: Iterable[float]) -> Box:
    """The box between two corners that a browser sent."""
    x, y, z, u, v, w = (float(value) for corner in (low, high) for value in corner)
    return x, y, z, u, v, w


def box_edges(low: Float32[np.ndarray, "3"], high: Float32[np.ndarray, "3"]) -> Float32[np.ndarray, "12 2 3"]:
    """The edges of a box, by two opposite corners."""
    ends = np.stack([low, high])
    edges = []
    for axis in range(3):
        for a in (0, 1):
            for b in (0, 1):
                picks = np.zeros((2, 3), int)
                picks[:, (axis + 1) % 3], picks[:, (axis + 2) % 3], picks[1, axis] = a, b, 1
                edges.append(ends[picks, np.arange(3)])
    return np.stack(edges)
