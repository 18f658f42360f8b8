"""The list of metrics, and how one is shown."""

from pathlib import Path

import pytest

from warpgs.evaluation.metric import Metric
from warpgs.evaluation.metrics import METRICS

RUN_FOLDER = (Path(__file__).parents[2] / "docs" / "run-folder.md").read_text()


@pytest.mark.parametrize("name", sorted(set(METRICS) - {"num_gaussians"}))  # a sum, which metrics.json does not have
def test_every_metric_is_explained_in_the_documentation(name):
    assert f"`{name}`" in RUN_FOLDER


MEMORY = Metric("memory", unit="GB", scale=1e9, digits=2, reason="trained without a GPU")


def test_a_metric_is_told_in_its_unit_with_its_digits():
    assert MEMORY.told(2.345e9) == "memory 2.35 GB"
    assert MEMORY.heading == "memory [GB]"


def test_a_metric_that_was_not_measured_says_why():
    assert MEMORY.told(None) == "memory not measured (trained without a GPU)"


def test_a_metric_without_a_unit_is_told_without():
    assert Metric("SSIM").told(0.98765) == "SSIM 0.9877"
    assert Metric("SSIM").heading == "SSIM"
