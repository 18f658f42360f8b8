"""Fixtures of the tests of captures as a whole."""

from tests.data.conftest import edited, root, with_boards, without_motion, written

__all__ = ["edited", "root", "with_boards", "without_motion", "written"]
