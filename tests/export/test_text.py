"""Bytes as text that a page can hold."""

import json
import re

import numpy as np
import pytest

from tests.export import node
from tests.export.pages import from_text
from warpgs.export import page
from warpgs.export.page import REPLACED, to_text

RANDOM = np.random.default_rng(0)
SAMPLES = [
    *(bytes(length) for length in range(9)),
    *(bytes([value] * length) for value in (13, 60, 255) for length in (1, 2, 7)),
    *(RANDOM.integers(0, 256, length, dtype=np.uint8).tobytes() for length in (1, 2, 6, 7, 8, 50_000)),
    b"\x1a<\r\0<!--</script>",
]


@pytest.mark.parametrize("data", SAMPLES, ids=len)
def test_bytes_are_restored(data):
    assert from_text(to_text(data)) == data


@pytest.mark.parametrize("data", SAMPLES, ids=len)
def test_text_has_no_character_that_a_page_changes(data):
    assert not set(to_text(data)) & set(REPLACED)


def test_text_takes_an_eighth_more_than_the_bytes():
    data = RANDOM.integers(0, 256, 70_000, dtype=np.uint8).tobytes()
    assert len(to_text(data).encode()) == pytest.approx(80_000, abs=10)


@pytest.mark.skipif(node.NODE is None, reason="the test needs node")
def test_the_player_decodes_the_same_bytes(tmp_path):
    player = page._player("", "", "")
    program = re.search(r"const REPLACED = .*?\n}\n", player, re.DOTALL)[0]
    texts = json.dumps([to_text(data) for data in SAMPLES])
    printed = node.run(tmp_path, f"{program}console.log(JSON.stringify({texts}.map((text) => [...bytesOf(text)])))")
    assert json.loads(printed) == [list(data) for data in SAMPLES]
