"""Run folders for tests."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests import plain
from warpgs.config import TrainConfig
from warpgs.data.capture import Capture
from warpgs.runs.run import Run, new_folder


def create(config: TrainConfig, capture: Capture) -> Path:
    """The folder of a new run, without checkpoints."""
    return Run.create(new_folder(config, capture), plain.plan(config)).folder


def edit(run: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Changes the values of a run's config.json."""
    values = json.loads((run / "config.json").read_text())
    change(values)
    (run / "config.json").write_text(json.dumps(values))
