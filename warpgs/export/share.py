"""What programs show of a page where its address is shared: a title, a description and a picture.

They read it from the page's ``<meta>`` elements, as of https://ogp.me; Twitter falls back to these. Most take only
absolute addresses of pictures.
"""

import html
import os
import re
from pathlib import Path
from urllib.parse import quote

import numpy as np
import torch
from jaxtyping import UInt8

from warpgs.cameras import Camera, intrinsic_matrix
from warpgs.runs.trained import TrainedScene
from warpgs.visualize.images import to_bytes

from .start_camera import StartView

SIZE = (1200, 630)
"""Width and height of the picture [px], which services show without cropping it."""

TIME = 0.5
"""Time of the picture, that of ``StartView.viewmat``."""

ADDRESS = re.compile(r"https?://[\w.-]+(:\d+)?(/[\w.~%!$&'()*+,;=:@-]*)*", re.ASCII)
"""Addresses of folders: a host, perhaps a port, and a path."""


def picture_path(page: Path) -> Path:
    """The file of the picture, next to the page."""
    return page.with_suffix(".preview.png")


def picture(scene: TrainedScene, start: StartView) -> UInt8[np.ndarray, "H W 3"]:
    """What a page is shown by: its first view, which covers the picture."""
    (width, height), (fx, fy, cx, cy) = start.size, start.intrinsics
    zoom = max(SIZE[0] / width, SIZE[1] / height)
    center = (0.5 * SIZE[0] + zoom * (cx - 0.5 * width), 0.5 * SIZE[1] + zoom * (cy - 0.5 * height))
    K = torch.from_numpy(intrinsic_matrix((zoom * fx, zoom * fy), center)).float()
    camera = Camera(torch.tensor(start.viewmat), K, *SIZE, time=TIME)
    return to_bytes(scene.render(camera).joint.image.clamp(0, 1))


def check_url(url: str) -> None:
    """Refuses what is not the address of a folder on the web.

    Raises:
        ValueError: If it is not.
    """
    if not ADDRESS.fullmatch(url) or url.endswith((".html", ".htm")):
        raise ValueError(f"--url must be the address of a folder, such as https://example.org/scenes, got {url!r}")


def card(start: StartView, count: int, page: Path, url: str | None) -> str:
    """The elements of a page for programs that show it where its address is shared.

    Args:
        start: How the page starts.
        count: Number of Gaussians.
        page: File of the page.
        url: Address of the folder in which it will be; None if that is not known.
    """
    folder = "" if url is None else f"{url.rstrip('/')}/"
    description = f"A moving scene of {start.seconds:g} s, of {count:,} Gaussians: drag to look around."
    properties = {
        "og:type": "website",
        "og:title": start.title,
        "og:description": description,
        "og:image": folder + quote(os.fsencode(picture_path(page).name)),
        "og:image:width": SIZE[0],
        "og:image:height": SIZE[1],
    }
    if url is not None:
        properties["og:url"] = folder + quote(os.fsencode(page.name))
    lines = [f'<meta name="description" content="{description}">']
    lines += [f'<meta property="{name}" content="{html.escape(str(value))}">' for name, value in properties.items()]
    return "\n".join([*lines, '<meta name="twitter:card" content="summary_large_image">'])
