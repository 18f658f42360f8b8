"""``warpgs bench --steps`` and ``--fps``: whole training steps, and frames per second of a trained scene."""

import dataclasses
import statistics
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import ModelConfig
from warpgs.config.presets import PRESETS
from warpgs.data.capture import Capture, Frame
from warpgs.evaluation.scene_metrics import frame_rate
from warpgs.initialization.point_cloud import scene_box
from warpgs.model.gaussians import SH_C0, Gaussians
from warpgs.model.scene import SplitScene
from warpgs.model.splats import Splats
from warpgs.runs.run import Run
from warpgs.runs.trained import TrainedScene
from warpgs.runtime.graphs import WARM_UPS
from warpgs.training.losses import DepthTrust
from warpgs.training.schedule import IterationPlan, Phase, Protocol
from warpgs.training.step import Sample, Step
from warpgs.video.camera_paths import filling
from warpgs.views.views import Views

from .report import print_rows
from .scenes import SEED, in_disc, random_splats
from .timing import milliseconds

MIN_SIZE = (480, 270)
STEPS = {
    "cuda": [
        *((num, MIN_SIZE) for num in (50_000, 100_000, 133_000, 200_000, 400_000, 800_000, 1_600_000)),
        *((100_000, size) for size in ((960, 540), (1920, 1080), (3840, 2160))),
    ],
    "cpu": [*((num, (240, 136)) for num in (5_000, 10_000)), (5_000, MIN_SIZE)],
}
"""Numbers of Gaussians and image sizes to measure; Deformable-3DGS ends with 133,000 on a capture of this size."""

PIXELS = 3.0
"""Twice the median standard deviation of a Gaussian on screen, per 480 pixels of image width [px]."""

NUM_VIEWS = 4


def random_capture(splats: Splats, camera: Camera) -> Capture:
    """A capture of noise with a disc as dynamic region; its points are the means of the Gaussians."""
    generator = torch.Generator().manual_seed(SEED)
    width, height = camera.size
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    at_depth_1 = torch.ones(height * width, dtype=torch.float32)
    static = ~in_disc(camera.unproject(rows.flatten(), columns.flatten(), at_depth_1), camera).reshape(height, width)
    image = torch.randint(0, 256, (height, width, 3), dtype=torch.uint8, generator=generator)
    cameras = {str(k): dataclasses.replace(camera, time=k / (NUM_VIEWS - 1)) for k in range(NUM_VIEWS)}
    inverse_depth = torch.full((height, width), 0.2, dtype=torch.float32)

    def read(name: str) -> Frame:
        return Frame(name, cameras[name], image, static, inverse_depth)

    return Capture("noise", cameras, list(cameras), [], splats.means, None, read)


def random_scene(splats: Splats, dynamic: Bool[Tensor, " N"], config: ModelConfig) -> SplitScene:
    """The Gaussians before activation, with networks."""
    assert splats.colors is not None
    parts = []
    for part in (~dynamic, dynamic):
        parts.append(
            Gaussians(
                splats.means[part],
                splats.quats[part],
                splats.scales[part].log(),
                splats.opacities[part].clamp(1e-4, 1.0 - 1e-4).logit(),
                ((splats.colors[part] - 0.5) / SH_C0)[:, None],
                torch.zeros(int(part.sum()), (config.sh_degree + 1) ** 2 - 1, 3, dtype=torch.float32),
            )
        )
    return SplitScene(parts[0], parts[1], config, *scene_box(splats.means))


def bench_steps(device: str, repeats: int, preset: str) -> list[dict[str, Any]]:
    """Measures training steps (render, loss, backward pass, Adam) of both stages; prints and returns the results."""
    rows = [measure_steps(num, size, device, repeats, preset) for num, size in STEPS[device]]
    print_rows(f"whole training steps of {preset}, medians", rows)
    return rows


def measure_steps(num_gaussians: int, size: tuple[int, int], device: str, repeats: int, preset: str) -> dict[str, Any]:
    """Median time [ms] of a step of stage I, of stage II and of 3DGS, and on CUDA the maximum memory of tensors [MB].

    A step of 3DGS has no networks, no depth and no dynamic Gaussians, and renders the joint image alone.
    """
    splats, camera = random_splats(num_gaussians, *size, PIXELS * size[0] / MIN_SIZE[0], SEED)
    config = dataclasses.replace(PRESETS[preset], device="cuda" if device == "cuda" else "cpu")
    capture = random_capture(splats, camera)
    views = Views(capture, torch.device(device), config.resident_bytes)
    alignments = torch.tensor([[1.0, 0.0]], dtype=torch.float32, device=device).repeat(NUM_VIEWS, 1)
    trust = DepthTrust(
        torch.ones(NUM_VIEWS, dtype=torch.float32, device=device),
        torch.zeros(NUM_VIEWS, dtype=torch.float32, device=device),
    )
    dynamic = in_disc(splats.means, camera)
    scene = random_scene(splats, dynamic, config.model).to(device)
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    protocol = Protocol(config, has_depth=True)
    result: dict[str, Any] = {"gaussians": num_gaussians, "width": size[0], "height": size[1]}
    for stage in (protocol.stage1, protocol.stage2):
        step = Step(config, scene, views, alignments, trust, capture.view_size)
        plan = protocol.at((stage.start + stage.end) // 2)
        result[f"{stage.name}_ms"] = statistics.median(_times(step, plan, device, repeats))
    scene = random_scene(splats, torch.zeros_like(dynamic), config.model).to(device)
    step = Step(dataclasses.replace(config, frozen="nothing"), scene, views, alignments, trust, capture.view_size)
    plain = dataclasses.replace(plan, phase=plain_phase(plan.phase))
    result["3dgs_ms"] = statistics.median(_times(step, plain, device, repeats))
    if device == "cuda":
        result["peak_memory_mb"] = torch.cuda.max_memory_allocated() // 10**6
    return result


def plain_phase(phase: Phase) -> Phase:
    """A phase of stage II without networks and depth, in which the joint image alone is compared: a step of 3DGS."""
    return dataclasses.replace(
        phase, use_deformation=False, use_appearance=False, with_depth=False, with_branches=False
    )


def _times(step: Step, plan: IterationPlan, device: str, repeats: int) -> Iterable[float]:
    samples = [Sample(k % NUM_VIEWS, 0.0, k) for k in range(repeats)]
    for sample in [samples[0]] * (WARM_UPS + 2 if device == "cuda" else 1):
        step(plan, sample)
    return [milliseconds(partial(step, plan, sample), device) for sample in samples]


def bench_fps(folder: Path, device: str, sizes: Sequence[tuple[int, int]] = ()) -> list[dict[str, Any]]:
    """Frames per second of a run's newest checkpoint through its evaluation cameras; prints and returns the results.

    The images have the given (width, height), or without any the size of the capture.
    """
    run = Run.open(folder, "cuda" if device == "cuda" else "cpu")
    capture, scene = run.open_capture(), run.trained_scene()
    cameras = [capture.cameras[name].pinhole for name in capture.val or capture.train]
    results = []
    for size in sizes or [cameras[0].size]:
        results.append(
            _frames_per_second(folder, scene, [filling(camera, size).to(scene.device) for camera in cameras])
        )
    print_rows("frames per second, both networks evaluated for every frame", results)
    return results


def _frames_per_second(folder: Path, scene: TrainedScene, cameras: Sequence[Camera]) -> dict[str, Any]:
    """Frames per second through cameras of one size."""
    result: dict[str, Any] = {
        "run": str(folder),
        "width": cameras[0].width,
        "height": cameras[0].height,
        "static": len(scene.scene.static),
        "dynamic": len(scene.scene.dynamic),
        "frames_per_second": frame_rate(scene.play, cameras),
    }
    if scene.device.type == "cuda":  # on CPU both are the same
        result["eager_frames_per_second"] = frame_rate(scene.render, cameras)
    return result
