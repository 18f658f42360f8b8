"""A training in a process of its own, to be killed."""

from pathlib import Path

from tests import tiny


def train(data: Path, run: Path) -> None:
    """Trains a tiny run from its newest checkpoint, or from the beginning."""
    with tiny.in_haste():
        trainer = tiny.trainer(data, run)
        trainer.restore_newest(print)
        tiny.train(trainer)
