"""The controls beside the image."""

from typing import Any

import numpy as np
import viser

from .cleanup_controls import CleanupControls
from .layers import LAYERS
from .path_controls import PathControls
from .status import status_html
from .training_cameras import TrainingCameras

PLAY, PAUSE = "Play", "Pause"
BACK, FORWARD = "◀", "▶"
HELP = "Space: play · drag: orbit · right drag: pan · wheel: zoom · W A S D Q E: fly"
TIMES, SPEEDS, WIDTHS = (0.0, 1.0), (0.1, 4.0), (160, 1920)
"""Ranges of the sliders of time, speed and image width [px]."""

GAP = 8
"""Gap between the timeline and the borders of the image [px]."""


class Panel:
    """The controls of one browser; ``session`` and ``path_editor`` implement what they do.

    Args:
        gui: Where to add them.
        training: The training cameras, if there are any.
        width: Initial width of the image at rest [px].
        is_narrow: Whether the panel would cover the image: then all folders but the time's are closed, and the
            timeline is one of them instead of lying below the image.

    Attributes:
        path, cleanup: The controls of camera paths, and of edits.
        timeline: The timeline below the image; None in the panel.
    """

    def __init__(
        self, gui: viser.GuiApi, training: TrainingCameras | None, width: int, is_narrow: bool = False
    ) -> None:
        self.status = gui.add_html(status_html(["starting"], []))
        self._filled = 0  # width of the canvas that the timeline has
        self.timeline = None if is_narrow else gui.add_panel()
        with gui.add_folder("Time") if self.timeline is None else self.timeline.add_tab("Time"):
            self.time = gui.add_slider("time", *TIMES, 0.001, 0.0)
            self.play = gui.add_button(PLAY, hint="Space")
        with gui.add_folder("Playback"):
            self.step = gui.add_button_group("frame", (BACK, FORWARD), hint="To the time of the next training frame")
            self.speed = gui.add_slider("speed", *SPEEDS, 0.1, 1.0, hint="1: the whole scene in 5 seconds")
            path = None if training is None else training.path
            hint = "Along the training cameras while time runs, until you move the camera"
            self.follow = gui.add_checkbox("follow camera", path is not None, disabled=path is None, hint=hint)
        with gui.add_folder("Image", expand_by_default=not is_narrow):
            self.layer = gui.add_dropdown("layer", tuple(LAYERS), initial_value=next(iter(LAYERS)))
            hint = "Off: static Gaussians have their own colours, without the appearance network"
            self.residual = gui.add_checkbox("appearance", True, hint=hint)
            hint = "Width at rest, at most the canvas's; while something changes, what the machine can render in time"
            self.width = gui.add_slider("width [px]", *WIDTHS, 80, width, hint=hint)
            self.screenshot = gui.add_button("Screenshot", hint="Downloads the image at this width as a PNG file")
        if training is not None:
            self._add_training(gui, training, is_narrow)
        self.path, self.cleanup = PathControls(gui), CleanupControls(gui)
        with gui.add_folder("Help", expand_by_default=False):
            gui.add_markdown(HELP)

    def fill(self, width: int) -> None:
        """Makes the timeline as wide as the canvas [px]."""
        if self.timeline is not None and width != self._filled:
            self._filled = width
            self.timeline.float(x=GAP, y=-GAP, width=max(1, width - 2 * GAP))

    # A browser may send any value, so each is checked again here.

    @property
    def current_time(self) -> float:
        """Time to show, in [0, 1]."""
        return clamped(self.time.value, TIMES)

    @property
    def current_speed(self) -> float:
        """Speed of playback."""
        return clamped(self.speed.value, SPEEDS)

    @property
    def current_width(self) -> int:
        """Width of the image at rest [px]."""
        return int(clamped(self.width.value, WIDTHS))

    @property
    def current_wipe(self) -> float:
        """Part of the image of a training camera that shows the truth, in [0, 1]; 0 without training cameras."""
        return clamped(self.wipe.value, (0.0, 1.0)) if hasattr(self, "wipe") else 0.0

    @property
    def shows_cameras(self) -> bool:
        """Whether the training cameras are to be shown in the scene."""
        return hasattr(self, "show_cameras") and bool(self.show_cameras.value)

    @property
    def current_layer(self) -> str:
        """Name of the layer to show, a key of ``LAYERS``."""
        name = self.layer.value
        return name if isinstance(name, str) and name in LAYERS else next(iter(LAYERS))

    def _add_training(self, gui: viser.GuiApi, training: TrainingCameras, is_narrow: bool) -> None:
        count, first = len(training.views), training.thumbnail(0)
        with gui.add_folder("Training cameras", expand_by_default=not is_narrow):
            hint = "Click a camera to look through it; they are hidden while you do, or they would cover the image"
            self.show_cameras = gui.add_checkbox("show in the scene", False, hint=hint)
            self.view = gui.add_slider("camera", 1, max(2, count), 1, 1, disabled=count < 2)
            self.snap = gui.add_button("Look through it")
            hint = "Left of the border is the training image, while camera and time are those of its recording"
            self.wipe = gui.add_slider("truth", 0.0, 1.0, 0.01, 0.0, hint=hint)
            image = np.zeros((1, 1, 3), np.uint8) if first is None else first
            self.truth = gui.add_image(image, label="training image")


def clamped(value: int | float, bounds: tuple[int | float, int | float]) -> float:
    """A number within bounds; the lower bound for NaN."""
    low, high = bounds
    return float(min(value, high)) if value >= low else float(low)


def set_value(control: Any, value: Any) -> None:
    """Sets the value of a control; viser declares it in a way that mypy takes for read-only."""
    control.value = value
