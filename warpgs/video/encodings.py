"""How videos are encoded: H.264 in MP4, and animations in GIF and WebP, by FFmpeg."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import av

BT709, LIMITED_RANGE = 1, 1
"""FFmpeg's numbers (libavutil/pixfmt.h) of BT.709, the same for colour space, primaries and transfer, and of a range of
16 to 235. Pixels are converted to them, and the file says so: without these tags players assume BT.601 below 720 lines
and show wrong colours."""

QUALITY = 18
"""Constant rate factor of H.264: 0 is lossless; at 18 the loss is hardly visible."""

WEBP_QUALITY = 90
"""Quality of WebP in [0, 100]."""

Convert = Callable[[Any], Iterator[Any]]
"""Converts an RGBA frame, or None after the last one, to the frames that the encoder can take by then."""

Converter = Callable[[tuple[int, int], Fraction], Convert]
"""Makes the conversion of frames of a (width, height) and a frame rate."""


@dataclass(frozen=True)
class Encoding:
    """A type of video file.

    Attributes:
        codec: FFmpeg's encoder.
        muxer: FFmpeg's container.
        pixels: Pixel format of the encoder.
        converter: See ``Converter``.
        max_rate: Maximum number of frames per second.
        is_even: Whether width and height must be even.
        has_alpha: Whether pixels can be transparent.
        color: Colour tags of the encoder, by the name of its attribute.
        codec_options: Options of the encoder.
        muxer_options: Options of the container.
    """

    codec: str
    muxer: str
    pixels: str
    converter: Converter
    max_rate: float = 1000.0
    is_even: bool = False
    has_alpha: bool = True
    color: dict[str, int] = field(default_factory=dict)
    codec_options: dict[str, str] = field(default_factory=dict)
    muxer_options: dict[str, str] = field(default_factory=dict)


def _to(**target: Any) -> Converter:
    """Every frame by itself, in the format that PyAV's ``reformat`` is asked for."""

    def convert(frame: Any) -> Iterator[Any]:
        if frame is not None:
            yield frame.reformat(**target)

    return lambda size, rate: convert


def _to_palette(size: tuple[int, int], rate: Fraction) -> Convert:
    """256 colours per frame, chosen for this frame, with dithering."""
    graph: Any = av.filter.Graph()
    source = graph.add_buffer(width=size[0], height=size[1], format="rgba", time_base=1 / rate)
    split, sink = graph.add("split"), graph.add("buffersink")
    palette, use = graph.add("palettegen", "stats_mode=single"), graph.add("paletteuse", "new=1")
    source.link_to(split)
    split.link_to(palette, 0, 0)
    split.link_to(use, 1, 0)
    palette.link_to(use, 0, 1)
    use.link_to(sink)
    graph.configure()

    def convert(frame: Any) -> Iterator[Any]:
        graph.push(frame)
        while True:
            try:
                yield graph.pull()
            except (av.error.BlockingIOError, av.error.EOFError):
                return

    return convert


ENCODINGS = {
    ".mp4": Encoding(
        "libx264",
        "mp4",
        "yuv420p",
        _to(format="yuv420p", dst_colorspace=BT709, dst_color_range=LIMITED_RANGE),
        is_even=True,  # yuv420p has one colour per 2 × 2 pixels
        has_alpha=False,
        color={"color_range": LIMITED_RANGE, "colorspace": BT709, "color_primaries": BT709, "color_trc": BT709},
        codec_options={"crf": str(QUALITY)},
        # With the index in front, a browser can play the file while it is still loading.
        muxer_options={"movflags": "faststart"},
    ),
    # Browsers show a GIF at 10 FPS if its frames last less than two hundredths of a second.
    ".gif": Encoding("gif", "gif", "pal8", _to_palette, max_rate=50.0),
    ".webp": Encoding(
        "libwebp_anim",
        "webp",
        "bgra",
        _to(format="bgra"),
        codec_options={"quality": str(WEBP_QUALITY)},
        muxer_options={"loop": "0"},
    ),
}
"""Encodings by the suffix of the file."""
