"""Alignment of held-out cameras."""

import dataclasses

import pytest
import torch

from tests.scenes import make_camera, make_splats
from warpgs.config import RenderSettings
from warpgs.evaluation.poses import MAX_CORRECTION, aligned_camera, alignment
from warpgs.model.poses import PoseCorrections
from warpgs.rendering import render
from warpgs.runs.run import Run
from warpgs.runs.trained import TrainedScene

CAMERA, SETTINGS = make_camera(), RenderSettings(antialias=True)


def image(splats, camera):
    return render(splats, camera, settings=SETTINGS).joint.image


@torch.no_grad()
def test_a_camera_that_was_moved_finds_back():
    splats, poses = make_splats(), PoseCorrections(torch.zeros(1, dtype=torch.int64), 4.0)
    poses.rotations += torch.tensor([0.01, -0.012, 0.008])
    poses.translations += torch.tensor([0.004, -0.003, 0.002])
    moved = dataclasses.replace(CAMERA, viewmat=poses(CAMERA.viewmat, torch.tensor([0])))
    truth = image(splats, CAMERA)
    aligned = aligned_camera(splats, moved, truth, 4.0, SETTINGS)
    assert not aligned.viewmat.requires_grad
    assert (aligned.viewmat - CAMERA.viewmat).norm() < 0.1 * (moved.viewmat - CAMERA.viewmat).norm()
    assert (image(splats, aligned) - truth).abs().mean() < 0.1 * (image(splats, moved) - truth).abs().mean()


def test_a_part_that_is_somewhere_else_does_not_move_a_camera():
    splats = make_splats()
    truth = image(splats, CAMERA)
    truth[8:18, 10:22] = 1.0
    aligned = aligned_camera(splats, CAMERA, truth, 4.0, SETTINGS)
    assert (aligned.viewmat - CAMERA.viewmat).norm() < 0.005  # 0.31 with a quadratic loss


@pytest.mark.parametrize("region", [None, torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)])
def test_a_camera_stays_where_nothing_is_rendered_or_compared(region):
    splats = dataclasses.replace(make_splats(), means=torch.full((60, 3), -5.0))
    truth = torch.rand(CAMERA.height, CAMERA.width, 3)
    assert torch.equal(aligned_camera(splats, CAMERA, truth, 4.0, SETTINGS, region).viewmat, CAMERA.viewmat)


def scene_and_capture(finished_run, poses):
    run = Run.open(finished_run, "cpu")
    trained = run.trained_scene()
    config = dataclasses.replace(trained.config, optim=dataclasses.replace(trained.config.optim, poses=poses))
    return TrainedScene(trained.scene, config, trained.metadata), run.open_capture(quiet=True)


@pytest.mark.parametrize("poses", [0.0, 1e-3])
def test_held_out_cameras_are_aligned_if_poses_were_corrected(finished_run, poses):
    scene, capture = scene_and_capture(finished_run, poses)
    frame = capture.frame(capture.val[0])
    aligned = alignment(scene, capture.median_depth)(frame)
    assert torch.equal(aligned.viewmat, frame.camera.viewmat) == (poses == 0.0)
    limit = 2.0 * MAX_CORRECTION * max(1.0, capture.median_depth)  # this scene is poor: images would lead far away
    assert (aligned.viewmat - frame.camera.viewmat).abs().max() < limit
    assert aligned.time == frame.camera.time


def test_pixels_that_are_not_covisible_do_not_align_a_camera(finished_run):
    scene, capture = scene_and_capture(finished_run, 1e-3)
    frame = capture.frame(capture.val[0])
    seen = torch.zeros(frame.image.shape[:2], dtype=torch.bool)
    seen[:12] = True
    changed = torch.where(seen[..., None], frame.image, 255 - frame.image)
    align = alignment(scene, capture.median_depth)
    cameras = [align(dataclasses.replace(frame, image=image, covisible=seen)) for image in (frame.image, changed)]
    assert torch.equal(cameras[0].viewmat, cameras[1].viewmat)
