"""The controls beside the picture."""

from typing import Any

import numpy as np
import viser

from .layers import LAYERS
from .training_cameras import TrainingCameras

PLAY, PAUSE = "Play", "Pause"
CONTROLS = "Drag: orbit · right drag: pan · wheel: nearer, farther · W A S D Q E: fly"
MOMENTS, SPEEDS, WIDTHS = (0.0, 1.0), (0.1, 4.0), (160, 1920)
"""Ends of the sliders of time, speed and pixels."""

MARKED = "\\`*_{}[]()#+!|<>&~"
"""Characters that mean something in Markdown or HTML."""


class Panel:
    """One browser's controls; what they do is said in ``session`` and ``path_editor``."""

    def __init__(self, gui: viser.GuiApi, training: TrainingCameras | None, width: int) -> None:
        self.status = gui.add_markdown("starting")
        with gui.add_folder("Time"):
            self.time = gui.add_slider("time", *MOMENTS, 0.001, 0.0)
            self.play = gui.add_button(PLAY)
            self.speed = gui.add_slider("speed", *SPEEDS, 0.1, 1.0, hint="1: all of the time in 5 seconds")
        with gui.add_folder("Picture"):
            self.layer = gui.add_dropdown("layer", LAYERS, initial_value=LAYERS[0])
            self.residual = gui.add_checkbox(
                "residual", True, hint="Off: static Gaussians without MLP_app, as w⁰ alone"
            )
            hint = "At rest; fewer while something moves and the machine can't keep up"
            self.width = gui.add_slider("pixels", *WIDTHS, 80, width, hint=hint)
        if training is not None:
            self._add_training(gui, training)
        with gui.add_folder("Camera path"):
            self.path_name = gui.add_text("name", "path", hint="Saved in the run folder as paths/NAME.json")
            self.add_keyframe = gui.add_button("Add keyframe", hint="This view at this time")
            self.remove_keyframe = gui.add_button("Remove last")
            self.save_path = gui.add_button("Save path")
            self.path_note = gui.add_markdown("no keyframes")
        gui.add_markdown(CONTROLS)

    # A browser may send any number, whatever the ends of its sliders are.

    @property
    def moment(self) -> float:
        """In [0, 1]."""
        return _within(self.time.value, MOMENTS)

    @property
    def pace(self) -> float:
        """Speed of time."""
        return _within(self.speed.value, SPEEDS)

    @property
    def across(self) -> int:
        """Width of the picture at rest [px]."""
        return int(_within(self.width.value, WIDTHS))

    def _add_training(self, gui: viser.GuiApi, training: TrainingCameras) -> None:
        count, first = len(training.views), training.picture(0)
        with gui.add_folder("Training cameras"):
            self.show_cameras = gui.add_checkbox("show", False, hint="Click on one to look through it")
            self.view = gui.add_slider("view", 1, max(2, count), 1, 1, disabled=count < 2)
            self.snap = gui.add_button("Look through it")
            self.truth = gui.add_image(np.zeros((1, 1, 3), np.uint8) if first is None else first, label="its picture")


def _within(value: int | float, ends: tuple[int | float, int | float]) -> float:
    """A number between two ends; the first of what is no number."""
    low, high = ends
    return float(min(value, high)) if value >= low else float(low)


def put(control: Any, value: Any) -> None:
    """Sets a control's value, which viser declares in a way that mypy takes for read-only."""
    control.value = value


def plain(text: str) -> str:
    """A text as the panel shows it, on one line, without what Markdown or HTML would read into it."""
    return "".join(f"\\{c}" if c in MARKED else c for c in " ".join(text.split()))
