"""Findings of the check of a capture, and the report of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from warpgs.errors import visible

Level = Literal["error", "warning", "note"]

MAX_NAMED = 3
"""Number of frames that a finding names where there are many."""


def few_of(names: Sequence[str]) -> str:
    """Names in a sentence: all of a few, else the first ``MAX_NAMED`` and the number of the others."""
    others = len(names) - MAX_NAMED
    return ", ".join(names) if others < 2 else f"{', '.join(names[:MAX_NAMED])} and {others} others"


@dataclass(frozen=True)
class Finding:
    """One result of the check.

    Attributes:
        level: "error" if training would fail, "warning" if quality would suffer, "note" otherwise.
        topic: The part of the capture that it concerns, in one word.
        text: One sentence.
    """

    level: Level
    topic: str
    text: str

    def __str__(self) -> str:
        return f"{self.level}: {visible(self.text)}"


@dataclass(frozen=True)
class Report:
    """All findings of a capture."""

    root: Path
    findings: list[Finding]

    @property
    def is_fit(self) -> bool:
        """Whether there are no errors."""
        return not any(f.level == "error" for f in self.findings)

    def plain(self) -> dict[str, Any]:
        """The report as a JSON object."""
        return {"capture": str(self.root), "fit": self.is_fit, "findings": [asdict(f) for f in self.findings]}

    def __str__(self) -> str:
        order = {"note": 0, "warning": 1, "error": 2}
        lines = [str(f) for f in sorted(self.findings, key=lambda f: order[f.level])]
        verdict = "fit to train on" if self.is_fit else "not fit to train on"
        return "\n".join([*lines, f"{visible(str(self.root))}: {verdict}"])


class UnfitCaptureError(ValueError):
    """The capture has errors that would make training useless.

    Attributes:
        findings (tuple[Finding, ...]): The errors.
    """

    def __init__(self, findings: Sequence[Finding]) -> None:
        super().__init__("; ".join(finding.text for finding in findings))
        self.findings = tuple(findings)
