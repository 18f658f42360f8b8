"""Lines that break between words."""

import io

import pytest

from tests.terminal import Terminal
from warpgs.command_line.screen import show, wrapped


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("one two three", ["one two", "three"]),
        ("one two", ["one two"]),
        ("", [""]),
        ("a\n\nb", ["a", "", "b"]),
        ("one  two   six", ["one  two", "six"]),
        ("  one two six", ["  one", "  two", "  six"]),
        (" a   one two six", [" a   one", "     two", "     six"]),
        ("/a/long/path is", ["/a/long/path", "is"]),
        ("in /a/long/path", ["in", "/a/long/path"]),
        ("\x1b[1mone\x1b[0m two six", ["\x1b[1mone\x1b[0m two", "six"]),
        ("日本 日本 日本", ["日本", "日本", "日本"]),
    ],
)
def test_lines_break_between_words_and_continue_below_their_start(text, lines):
    assert wrapped(text, 8) == "\n".join(lines)


def test_usage_continues_after_its_head_and_keeps_an_option_in_one_line():
    usage = "usage: warpgs check [-h] CAPTURE [--json | --no-json]"
    assert wrapped(usage, 40).split("\n") == ["usage: warpgs check [-h] CAPTURE", "       [--json | --no-json]"]


def test_what_is_no_terminal_gets_whole_lines():
    file = io.StringIO()
    show("word " * 100 + "end", file)
    assert file.getvalue() == "word " * 100 + "end\n"


def test_a_stream_that_does_not_know_whether_it_is_a_terminal_gets_whole_lines():
    class Tee:
        written = ""

        def write(self, text):
            self.written += text

        def flush(self):
            pass

    tee = Tee()
    show("word " * 100 + "end", tee)
    assert tee.written == "word " * 100 + "end\n"


@pytest.mark.parametrize(
    ("columns", "code", "words"),
    [
        (60, "from warpgs.cli import main; main(['train', '--data', 'nerfds/as'])", "CAPTURE (your own video)"),
        (80, "from warpgs.cli import main; main(['train', '--preset', 'nosuch'])", "got 'nosuch'"),
        (
            60,
            "from warpgs.runs.logger import TrainingLogger; TrainingLogger(None, 9, 0).log('long ' * 30 + 'END')",
            "END",
        ),
    ],
)
def test_messages_on_a_terminal_break_between_words(columns, code, words):
    with Terminal(code, columns=columns) as terminal:
        shown = terminal.read_until(words.split()[-1])
    lines = shown.split("\n")
    assert len(lines) > 1
    assert all(len(line) <= columns or " " not in line for line in lines)
    assert words in " ".join(lines)
