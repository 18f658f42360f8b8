"""What programs show of a page where its address is shared."""

import dataclasses
import html
import re
from pathlib import Path

import cv2
import pytest

from tests.export import scenes
from tests.export.test_page import start
from warpgs.export.baking import bake
from warpgs.export.page import write_page
from warpgs.export.share import SIZE, card, check_url, picture
from warpgs.visualize.images import to_bytes

NAME = Path("folder/my scene.html")


def properties(text):
    found = re.findall(r'<meta (?:property|name)="([^"]+)" content="([^"]*)">', text)
    return {name: html.unescape(content) for name, content in found}


def test_a_page_names_what_services_show_of_it(path, clouds):
    write_page(path, bake(clouds.at, [0.0]), start("Tür"))
    shown = properties(path.read_text())
    assert shown["og:title"] == "Tür"
    assert shown["og:description"] == "A moving scene of 4 s, of 60 Gaussians: drag to look around."
    assert shown["description"] == shown["og:description"]
    assert (int(shown["og:image:width"]), int(shown["og:image:height"])) == SIZE
    assert shown["twitter:card"] == "summary_large_image"


@pytest.mark.parametrize("url", ["https://example.org/a", "https://example.org/a/"])
def test_addresses_are_absolute_if_that_of_the_folder_is_known(url):
    known, unknown = (properties(card(start(), 60, NAME, folder)) for folder in (url, None))
    assert known["og:image"] == "https://example.org/a/my%20scene.preview.png"
    assert known["og:url"] == "https://example.org/a/my%20scene.html"
    assert unknown["og:image"] == "my%20scene.preview.png"
    assert "og:url" not in unknown


def test_names_that_are_not_utf8_are_written_as_they_can_be(path, clouds):
    page = path.with_name("a\udcff.html")
    write_page(page, bake(clouds.at, [0.0]), start("b\udcff"), url="https://example.org")
    shown = properties(page.read_text())
    assert shown["og:title"] == "b?"
    assert shown["og:url"] == "https://example.org/a%FF.html"


def test_a_title_cannot_leave_its_attribute():
    title = '"><script>alert(1)</script>'
    text = card(start(title), 60, NAME, "https://example.org")
    assert "<script" not in text
    assert properties(text)["og:title"] == title


@pytest.mark.parametrize(
    "url",
    [
        "example.org",
        "ftp://example.org",
        "https://",
        "https://a b",
        'https://a/"><b>',
        "https://a/?b",
        "https://[a",
        "https://a/b.html",
    ],
)
def test_an_address_that_is_none_is_refused(url):
    with pytest.raises(ValueError, match="--url must be the address of a folder, such as https"):
        check_url(url)


@pytest.mark.parametrize("url", ["https://example.org", "http://127.0.0.1:8000/a/", "https://user.github.io/~a/b%20c"])
def test_an_address_is_accepted(url):
    check_url(url)


def test_the_picture_is_covered_by_the_first_view():
    scene = scenes.trained_scene()
    camera = dataclasses.replace(scenes.camera(*SIZE), time=0.5)
    camera.K[1, 2] = SIZE[1] / 2  # start() has images of 4:3, which are cut above and below
    wanted = to_bytes(scene.render(camera).joint.image.clamp(0, 1))
    assert cv2.PSNR(picture(scene, start()), wanted) > 50
