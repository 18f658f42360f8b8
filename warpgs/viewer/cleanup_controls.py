"""The controls of edits."""

import viser

from .path_controls import note_html

CORNERS = ("from", "to")
"""Names of the corners of the crop box."""

OPACITIES = (0.0, 1.0)
"""Range of the slider of opacity."""

ONLY, REMOVE, FREEZE = "Show alone", "Remove", "Freeze"
RECOLOR, SHIFT, RESET = "Recolour", "Shift", "Reset"
"""What can be done with an object."""

SHIFTS = (-1.0, 1.0)
"""Range of the slider of how much later an object moves."""

OFF, RECTANGLE, LASSO, BRUSH = "off", "rectangle", "lasso", "brush"
"""Tools that select Gaussians."""

DELETE, INVERT, CLEAR = "Delete", "Invert", "Clear"
"""What can be done with what is selected."""

RADII = (2.0, 200.0)
"""Range of the slider of the radius of the brush [px]."""


class CleanupControls:
    """A folder of controls; ``Cleanup`` implements what they do."""

    def __init__(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Clean up", expand_by_default=False):
            hint = (
                "Removes what is outside of a box at all times: drag the arrows of two corners, or type their positions"
            )
            self.crop = gui.add_checkbox("crop box", False, hint=hint)
            self.corners = [gui.add_vector3(name, (0.0, 0.0, 0.0), step=0.01, visible=False) for name in CORNERS]
            hint = "Removes what is fainter at all times"
            self.opacity = gui.add_slider("min opacity", *OPACITIES, 0.01, 0.0, hint=hint)
            hint = "Removes isolated Gaussians that the training cameras see little of"
            self.floaters = gui.add_checkbox("drop floaters", False, hint=hint)
            hint = (
                "Rectangle: drag. Lasso: click around, and at the first corner again. Brush: click. Adds what has its "
                "centre there; with Ctrl, removes it from the selection"
            )
            self.tool = gui.add_dropdown("select", (OFF, RECTANGLE, LASSO, BRUSH), hint=hint)
            self.radius = gui.add_slider("brush [px]", *RADII, 1.0, 20.0, visible=False)
            self.seen = gui.add_checkbox("only seen", False, hint="Leaves what is hidden behind others")
            self.selected = gui.add_button_group("selected", (DELETE, INVERT, CLEAR))
            hint = "Parts that move together, which can take a minute; the layer objects finds them, too"
            self.find = gui.add_button("Find objects", hint=hint)
            self.object = gui.add_dropdown("object", ("none",), hint="A number of the layer objects, or a box")
            self.choice = gui.add_button_group("action", (ONLY, REMOVE, FREEZE), hint="Freeze: at the current time")
            hint = "Recolour: in shades of the colour. Shift: by the time below. Reset: as it was trained"
            self.change = gui.add_button_group("change", (RECOLOR, SHIFT, RESET), hint=hint)
            self.color = gui.add_rgb("colour", (230, 60, 60))
            self.shift = gui.add_slider("later by", *SHIFTS, 0.01, 0.1)
            self.undo = gui.add_button("Undo", hint="The last edit")
            hint = "For all later commands, in the run folder as edits.json; the checkpoint stays as it is"
            self.save = gui.add_button("Save as edits", hint=hint)
            self.name = gui.add_text("new run", "", hint="A name; beside this run")
            hint = "A copy of the run with these edits, in a new folder"
            self.copy = gui.add_button("Save as a new run", hint=hint)
            self.note = gui.add_html(note_html("no edits"))
