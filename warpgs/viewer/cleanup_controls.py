"""The controls of edits."""

import viser

from .path_controls import note_html

CORNERS = ("from", "to")
"""Names of the corners of the crop box."""

OPACITIES = (0.0, 1.0)
"""Range of the slider of opacity."""

ONLY, REMOVE, FREEZE = "Show alone", "Remove", "Freeze"
"""What can be done with an object."""


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
            hint = "Parts that move together, which can take a minute; the layer objects finds them, too"
            self.find = gui.add_button("Find objects", hint=hint)
            self.object = gui.add_dropdown("object", ("none",), hint="A number of the layer objects, or a box")
            self.choice = gui.add_button_group("action", (ONLY, REMOVE, FREEZE), hint="Freeze: at the current time")
            self.undo = gui.add_button("Undo", hint="The last edit")
            hint = "For all later commands, in the run folder as edits.json; the checkpoint stays as it is"
            self.save = gui.add_button("Save as edits", hint=hint)
            self.note = gui.add_html(note_html("no edits"))
