"""Held-out views in TensorBoard."""

from types import SimpleNamespace

import pytest
import torch

import warpgs
from tests import tiny
from warpgs.evaluation import held_out
from warpgs.runs.progress import Progress, Status

pytestmark = pytest.mark.usefixtures("quickly")


def test_held_out_views_are_rendered_at_regular_intervals_of_a_run(finished_run, monkeypatch):
    capture = warpgs.open_run(finished_run).open_capture()
    image = SimpleNamespace(joint=SimpleNamespace(image=torch.zeros(tiny.SCENE.height, tiny.SCENE.width, 3)))
    config = SimpleNamespace(exposure=True)
    scene, written = SimpleNamespace(render=lambda camera: image, config=config), []

    class Logger:
        def add_image(self, *_: object) -> None:
            pass

        def add_scalar(self, name: str, value: float, iteration: int) -> None:
            written.append(iteration)

    callback = held_out.HeldOut(Logger())
    for iteration in range(50, 30_001, 50):
        callback(Progress(Status(iteration, "stage1", 0.1, 30.0, {}, 1, 1), 30_000, scene, capture))
    assert len(written) <= held_out.HELD_OUT_TIMES + 1
    assert written[-1] == 30_000


def test_a_held_out_frame_that_cannot_be_read_ends_the_held_out_images_and_not_the_training():
    def read(name):
        raise ValueError(f"{name}.png is damaged")

    lines = []
    callback = held_out.HeldOut(SimpleNamespace(log=lines.append))
    capture = SimpleNamespace(val=["a"], frame=read)
    for iteration in (50, 15_000, 30_000):
        callback(Progress(Status(iteration, "stage1", 0.1, 30.0, {}, 1, 1), 30_000, None, capture))
    assert lines == ["warning: without held-out views in TensorBoard: a.png is damaged"]
