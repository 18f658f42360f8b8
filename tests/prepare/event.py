"""An event that several cameras film, with sound: the bodies of ``warpgs sample``, ray-traced from several places."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import torch

from warpgs.cameras import Camera
from warpgs.prepare.frames.sample import _clutter, _moving
from warpgs.synthetic.bodies import as_tensors, even_samples
from warpgs.synthetic.raytrace import raytrace
from warpgs.visualize.images import to_bytes

SIZE = (320, 180)
"""(width, height) of the images [px]."""

RATE, SECONDS = 8, 4.0
"""Frames per second, and length of the event: what moves goes around once."""

LAMP = torch.tensor([[0.8, -2.2, 3.4], [0.06, 0.0, 0.0], [0.0, 0.06, 0.0]], dtype=torch.float32)


@dataclass(frozen=True)
class Filmed:
    """How a camera films the event.

    Attributes:
        place: Where it is when the event begins.
        travel: How far it moves to the right during the event.
        start: When its video starts [s of the event].
        frames: Number of frames.
        focal: Focal length over the width.
    """

    place: tuple[float, float, float]
    travel: float = 0.0
    start: float = 0.0
    frames: int = 24
    focal: float = 0.9

    def times(self) -> list[float]:
        """Times of the frames [s of the event]."""
        return [self.start + k / RATE for k in range(self.frames)]

    def camera(self, time: float) -> Camera:
        """The camera at a time [s of the event]."""
        part = time / SECONDS
        x, y, z = self.place
        shake = 0.03 * np.sin(9.0 * part) if self.travel else 0.0
        position = torch.tensor([x + self.travel * part, y + 3.0 * shake, z + 2.0 * shake], dtype=torch.float32)
        target = torch.tensor([0.2 * self.travel * (part - 0.5) + shake, 0.6, 0.75 + shake], dtype=torch.float32)
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float32)
        return Camera.looking_at(position, target, up, self.focal * SIZE[0], SIZE, part)


def trace(filmed: Filmed, samples: int = 2) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """[H, W, 3] RGB images, and [H, W] masks of what moves."""
    cpu, clutter = torch.device("cpu"), _clutter()
    images, masks = [], []
    for time in filmed.times():
        camera = filmed.camera(time)
        bodies = as_tensors([*clutter, *_moving(time / SECONDS)], cpu)
        traced = raytrace(bodies, LAMP, even_samples(samples, cpu), camera.viewmat, camera.K, camera.size)
        images.append(to_bytes(traced.image))
        masks.append(traced.bodies.numpy() >= len(clutter))
    return images, masks


def sound(seed: int = 0, seconds: float = 20.0, rate: int = 48_000) -> np.ndarray:
    """[N] clicks and tones that ring off, at random times."""
    random, samples = np.random.default_rng(seed), np.zeros(int(seconds * rate))
    for _ in range(int(4 * seconds)):
        length = int(rate * random.uniform(0.03, 0.2))
        begin, time = random.integers(0, len(samples) - length), np.arange(length) / rate
        tone = np.sin(2.0 * np.pi * random.uniform(200.0, 3000.0) * time)
        samples[begin : begin + length] += random.uniform(0.2, 1.0) * np.exp(-random.uniform(10, 60) * time) * tone
    return samples


def heard(samples: np.ndarray, start: float, seconds: float, rate: int = 48_000, gain: float = 0.5) -> np.ndarray:
    """[N] a recording at a rate of its own, with noise, of a sound at 48 kHz; at most 1."""
    time = start + np.arange(int(seconds * rate)) / rate
    noise = np.random.default_rng(rate + int(1000 * start)).standard_normal(len(time))
    recorded = gain * (np.interp(time, np.arange(len(samples)) / 48_000, samples) + 0.02 * noise)
    return np.clip(recorded, -1.0, 1.0)


def write_video(
    path: Path,
    images: Sequence[np.ndarray],
    recording: np.ndarray | None = None,
    rate: int = 48_000,
    sound_from: float = 0.0,
) -> Path:
    """Writes an MP4 file, with sound at this rate from this time on, if there is any."""
    height, width = images[0].shape[:2]
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=RATE, options={"crf": "10", "preset": "veryfast"})
        video.width, video.height, video.pix_fmt = width, height, "yuv444p"
        audio = None if recording is None else container.add_stream("aac", rate=rate, layout="mono")
        for image in images:
            for packet in video.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                container.mux(packet)
        container.mux(video.encode(None))
        if audio is not None and recording is not None:
            frame = av.AudioFrame.from_ndarray(recording.astype(np.float32)[None], format="fltp", layout="mono")
            frame.sample_rate, frame.pts, frame.time_base = rate, round(sound_from * rate), Fraction(1, rate)
            for piece in (frame, None):
                for packet in audio.encode(piece):
                    container.mux(packet)
    return path
