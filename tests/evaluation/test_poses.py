"""Alignment of held-out cameras."""

import dataclasses

import torch

from tests.scenes import make_camera, make_splats
from warpgs.config import RenderSettings
from warpgs.evaluation.poses import aligned_camera
from warpgs.model.poses import PoseCorrections
from warpgs.rendering import render

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
