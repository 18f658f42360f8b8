"""The controls of camera paths."""

import html

import viser

from .video_options import DURATIONS, RATES, SIDES, VideoOptions

NOTE_LINES, NOTE_LINE = 4, 1.4
"""Lines of the note, and height of one [em]."""

NEW = "(new path)"
"""Entry of the menu of saved paths that stands for none."""

DEFAULT_NAME = "path"
"""Name of a new path; numbered if it is taken."""

RENDER, CANCEL = "Render video", "Cancel video"
"""Labels of the button that starts and cancels a video."""

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
            video = VideoOptions()
            hint = "Of the preview and of the video"
            low, high = DURATIONS
            self.duration = gui.add_number("duration [s]", video.duration, min=low, max=high, step=0.1, hint=hint)
            low, high = RATES
            self.rate = gui.add_number("frame rate", video.rate, min=low, max=high, step=1.0, hint="FPS of the video")
            hint = "Width and height of the video; views are cropped to them, not stretched"
            ends = [(side, side) for side in SIDES]
            self.size = gui.add_vector2("size [px]", video.size, min=ends[0], max=ends[1], step=2, hint=hint)
            self.preview = gui.add_button(PREVIEW, hint="Moves along the path")
            self.save = gui.add_button("Save path")
            self.render = gui.add_button(RENDER, hint="Saves the path and renders it, as warpgs render does")
            self.progress = gui.add_progress_bar(0.0, visible=False)  # until a video is rendered
            self.download = gui.add_button("Download video", disabled=True, hint="The video that was rendered last")
            self.note = gui.add_html(note_html("no keyframes"))


def note_html(text: str) -> str:
    """A text in a field of one height, so that no control moves when it changes."""
    style = f"height: {NOTE_LINES * NOTE_LINE:g}em; line-height: {NOTE_LINE}; overflow: auto; font-size: 0.8em"
    return f'<div style="{style}; padding: 0 1em; overflow-wrap: anywhere">{html.escape(text)}</div>'
