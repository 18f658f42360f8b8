"""The command ``warpgs check``."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Check:
    """Checks whether a capture is fit to train on; exit code 1 if it is not."""

    capture: tyro.conf.Positional[Path]
    """Folder of the capture."""
    dataset: str | None = None
    """Layout: iphone, nerfds, hypernerf, nerfstudio, blender, llff, colmap, vipe or megasam; recognized from the files
    by default."""
    factor: int | None = None
    """Downscaling factor of the images; the dataset's usual one by default."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print JSON."""

    def run(self) -> None:
        """Prints the report.

        Raises:
            SystemExit: With code 1 if the capture is not fit to train on.
        """
        from .check import check_capture

        report = check_capture(self.capture, self.dataset, self.factor)
        print(json.dumps(report.plain(), indent=2) if self.as_json else report)
        if not report.is_fit:
            raise SystemExit(1)
