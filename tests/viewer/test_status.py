"""The status has one height, whatever it says."""

import re

from warpgs.viewer.status import status_html


def test_the_height_does_not_depend_on_the_texts():
    texts = [status_html(["a"], []), status_html(["a" * 999] * 3, ["b" * 999] * 9)]
    heights = [re.findall(r"height: ([0-9.]+)em", text) for text in texts]
    assert heights[0] == heights[1]
    assert len(heights[0]) == 2


def test_texts_are_escaped():
    text = status_html(['<b title="x">'], ["<script>"])
    assert "<b" not in text
    assert "<script" not in text
    assert text.count("&lt;b title=&quot;x&quot;&gt;") == 2
