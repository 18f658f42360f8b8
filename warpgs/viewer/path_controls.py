"""The controls of camera paths."""

import viser

NEW = "(new path)"
"""Entry of the menu of saved paths that stands for none."""

DEFAULT_NAME = "path"
"""Name of a new path; numbered if it is taken."""

PREVIEW, END_PREVIEW = "Preview", "End preview"
"""Labels of the button that starts and ends a preview."""


class PathControls:
    """A folder of controls; ``PathEditor`` implements what they do."""

    def __init__(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Camera path", expand_by_default=False):
            self.saved = gui.add_dropdown("saved", (NEW,), hint="Opens a path of the run folder, or starts one")
            self.name = gui.add_text("name", DEFAULT_NAME, hint="Saved in the run folder as paths/NAME.json")
            self.selected = gui.add_dropdown("keyframe", ("none",), hint="Goes to a keyframe, which is then selected")
            self.add = gui.add_button("Add keyframe", hint="The current camera and time, behind the selected keyframe")
            self.replace = gui.add_button("Replace keyframe", hint="By the current camera and time")
            self.remove = gui.add_button("Remove keyframe")
            self.preview = gui.add_button(PREVIEW, hint="Moves along the path, in 5 seconds")
            self.save = gui.add_button("Save path")
            self.render = gui.add_button("Render video", hint="Saves the path and renders it, as warpgs render does")
            self.note = gui.add_markdown("no keyframes")
