"""Alignment of held-out cameras."""

import dataclasses

import pytest
import torch

from tests.scenes import make_camera, make_splats
from warpgs.config import RenderSettings
from warpgs.evaluation import poses as evaluation_poses
from warpgs.evaluation.poses import aligned_camera, alignment
from warpgs.model.poses import PoseCorrections
from warpgs.rendering import render
from warpgs.runs.run import Run
from warpgs.runs.trained import TrainedScene

CAMERA = make_camera()


def image(splats, camera):
    return render(splats, camera, settings=RenderSettings(antialias=True)).joint.image


@torch.no_grad()
def test_a_camera_that_was_moved_finds_back():
    splats, poses = make_splats(), PoseCorrections(1, 4.0)
    poses.rotations += torch.tensor([0.01, -0.012, 0.008])
    poses.translations += torch.tensor([0.004, -0.003, 0.002])
    moved = dataclasses.replace(CAMERA, viewmat=poses(CAMERA.viewmat, torch.tensor([0])))
    truth = image(splats, CAMERA)
    aligned = aligned_camera(splats, moved, truth, 4.0, antialias=True)
    assert not aligned.viewmat.requires_grad
    assert (aligned.viewmat - CAMERA.viewmat).norm() < 0.1 * (moved.viewmat - CAMERA.viewmat).norm()
    assert (image(splats, aligned) - truth).abs().mean() < 0.1 * (image(splats, moved) - truth).abs().mean()


def scene_and_capture(finished_run, poses):
    run = Run.open(finished_run, "cpu")
    trained = run.trained_scene()
    config = dataclasses.replace(trained.config, optim=dataclasses.replace(trained.config.optim, poses=poses))
    return TrainedScene(trained.scene, config, trained.metadata), run.open_capture(quiet=True)


@pytest.mark.parametrize("poses", [0.0, 1e-3])
def test_held_out_cameras_are_aligned_if_poses_were_corrected(finished_run, monkeypatch, poses):
    monkeypatch.setattr(evaluation_poses, "ITERATIONS", 3)
    scene, capture = scene_and_capture(finished_run, poses)
    frame = capture.frame(capture.val[0])
    aligned = alignment(scene, capture.extent)(frame)
    assert torch.equal(aligned.viewmat, frame.camera.viewmat) == (poses == 0.0)
    assert (aligned.viewmat - frame.camera.viewmat).abs().max() < 0.1
    assert aligned.time == frame.camera.time


def test_pixels_that_are_not_covisible_do_not_align_a_camera(finished_run, monkeypatch):
    monkeypatch.setattr(evaluation_poses, "ITERATIONS", 3)
    scene, capture = scene_and_capture(finished_run, 1e-3)
    frame = capture.frame(capture.val[0])
    seen = torch.zeros(frame.image.shape[:2], dtype=torch.bool)
    seen[:12] = True
    changed = torch.where(seen[..., None], frame.image, 255 - frame.image)
    align = alignment(scene, capture.extent)
    cameras = [align(dataclasses.replace(frame, image=image, covisible=seen)) for image in (frame.image, changed)]
    assert torch.equal(cameras[0].viewmat, cameras[1].viewmat)
