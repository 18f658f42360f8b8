"""Training on frames that a rolling shutter recorded while the camera moved."""

import numpy as np
import pytest
import torch

from tests import tiny
from tests.training.test_lenses import psnr
from warpgs.cameras import Camera
from warpgs.data.capture import Capture, Frame
from warpgs.data.readout import with_readout
from warpgs.data.units import SceneUnits
from warpgs.initialization.prepare_start import prepare_start
from warpgs.synthetic import room
from warpgs.synthetic.bodies import as_tensors, even_samples
from warpgs.synthetic.raytrace import raytrace
from warpgs.training.trainer import Trainer

SIZE, NUM_FRAMES, NUM_POINTS = (44, 32), 12, 300
READOUT = 1.0
SCENE = room.BuiltinScene(*SIZE)


@pytest.fixture(autouse=True)
def _in_haste():
    with tiny.in_haste():
        yield


def traced(time: float, readout: float) -> tuple[torch.Tensor, ...]:
    """Image, depth and bodies of the room; with a readout every row from where the camera is then."""
    cpu = torch.device("cpu")
    bodies = as_tensors([*room._static_bodies(), *room._moving_bodies(time)], cpu)
    rows = []
    for row in range(SIZE[1]):
        s = (row + 0.5) / SIZE[1] - 0.5
        camera = room._camera(time + s * readout / (NUM_FRAMES - 1), SCENE, 0.0)
        K = camera.K.clone()
        K[1, 2] -= row
        rows.append(raytrace(bodies, room._lamp(cpu), even_samples(4, cpu), camera.viewmat, K, (SIZE[0], 1)))
    return tuple(torch.cat(parts) for parts in zip(*rows, strict=True))


def recorded(readout: float) -> Capture:
    """The room from the left camera of the built-in capture, every fourth frame for evaluation."""
    frames, points, units = {}, [], SceneUnits(np.array(room.CENTER), room.SCALE)
    for k in range(NUM_FRAMES):
        time = k / (NUM_FRAMES - 1)
        world = room._camera(time, SCENE, 0.0)
        center = units.from_world(world.position.double().numpy()[None])[0]
        pose = world.viewmat[:3, :3].double().numpy()
        camera = Camera.posed(pose, center, world.K.double().numpy(), SIZE, time)
        image, depth, bodies = traced(time, readout)
        static = bodies < len(room._static_bodies())
        frame = Frame(f"{k:02d}", camera, (image.clamp(0, 1) * 255).byte(), static, 1.0 / (room.SCALE * depth))
        frames[frame.name] = frame
        row, column = static.nonzero(as_tuple=True)
        chosen = torch.randperm(len(row), generator=torch.Generator().manual_seed(k))[: NUM_POINTS // NUM_FRAMES]
        row, column = row[chosen], column[chosen]
        _, still, _ = traced(time, 0.0)
        points.append(camera.unproject(row, column, room.SCALE * still[row, column]))
    val = [*frames][2::4]
    train = [name for name in frames if name not in val]
    cameras = {name: frame.camera for name, frame in frames.items()}
    return Capture("room", cameras, train, val, torch.cat(points), None, frames.__getitem__)


def test_a_step_deforms_gaussians_at_the_times_of_their_rows(tmp_path, monkeypatch):
    capture = with_readout(recorded(0.0), READOUT)
    trainer = Trainer(prepare_start(tiny.CONFIG, capture), tmp_path)
    trainer._add_dynamic_gaussians()
    plan = trainer.protocol.at(trainer.protocol.stage2.start)
    sample, asked = trainer._sample(plan)._replace(time_noise=0.0), []
    forward = trainer.scene.deformation.forward
    monkeypatch.setattr(trainer.scene.deformation, "forward", lambda m, t: asked.append(t) or forward(m, t))
    trainer.step(plan, sample)
    middle, times = asked
    times = times[: len(trainer.scene.dynamic)]  # those after them are of sampled paths
    assert len(times) == len(trainer.scene.dynamic) > len(middle) == 1
    assert times.unique().numel() > 1
    assert (times - middle).abs().max() <= capture.interval
    assert (times - middle).abs().max() > 0.1 * capture.interval


def test_frames_of_a_rolling_shutter_are_learned_better_with_their_readout(tmp_path):
    capture = recorded(READOUT)
    readout = with_readout(capture, READOUT)
    ignored = psnr(capture, capture, tmp_path / "ignored")
    assert psnr(readout, readout, tmp_path / "readout") > ignored
