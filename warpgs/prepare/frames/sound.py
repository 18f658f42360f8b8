"""When several videos of one event were started, from their sound.

The rise of loudness in bands of frequency (spectral flux; Bello et al. 2005) hardly depends on gain, distance, codec or
room. Two recordings are compared by the cross-correlation of these curves, summed over the bands. Its peak, refined by
a parabola, tells the offset to about a millisecond; how far it stands out of the next peak tells whether the two hear
the same.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from jaxtyping import Float

from warpgs.data.video_frames import READ_LOCAL_FILES
from warpgs.errors import one_line

from .video import decoded

RATE, WINDOW, HOP = 8000, 256, 32
"""Samples per second, per window of the spectrum, and between windows: onsets every 4 ms."""

BANDS = np.geomspace(4, 120, 9).round().astype(int)
"""Limits of the bands, as indices in the spectrum: 125 Hz to 3.75 kHz."""

MAX_SECONDS = 1800
"""Length of the sound that is compared, from its start [s]."""

FLOOR = 0.3
"""Quantile of a band's power that counts as its noise: changes below it do not matter."""

MAX_ONSET = 4.0
"""Onsets are clamped to this, in standard deviations: one bang must not outweigh everything else."""

MIN_OVERLAP = 1.0
"""Time that two recordings must have in common [s]."""

PEAK_WIDTH = 0.06
"""Distance from the peak within which the correlation belongs to it [s]."""

MIN_RATIO = 2.0
"""Ratio of the highest to the next peak from which on two recordings hear the same. Of 216 pairs of unrelated
synthetic recordings of 6 to 40 s it was 1.91 at most; of the same 12 s, with noise a tenth as loud, 2.27 at least."""

CHUNK = 4096
"""Number of windows whose spectrum is computed together."""


@dataclass(frozen=True)
class Onsets:
    """How suddenly the sound of a video becomes louder.

    Attributes:
        values: [B, T] in B bands, every ``HOP`` samples.
        start: Time of the first value after the first frame of the video [s].
    """

    values: Float[np.ndarray, "B T"]
    start: float


def read_onsets(source: Path, first_frame: Fraction) -> Onsets | None:
    """The onsets in the sound of a video; None if it has no sound, or silence.

    Args:
        source: The video.
        first_frame: Time stamp of its first frame [s].

    Raises:
        ValueError: If the sound cannot be decoded.
    """
    samples, start = _read_samples(source)
    if len(samples) < WINDOW + HOP or np.ptp(samples) == 0:
        return None
    values = _onsets(samples)
    return Onsets(values, start - float(first_frame) + WINDOW / 2 / RATE) if values.any() else None


def _read_samples(source: Path) -> tuple[Float[np.ndarray, " N"], float]:
    """Samples of a video's sound, and the time stamp of the first [s]; gaps and what is damaged are silent."""
    try:
        pieces = [*_read_pieces(source)]
    except (av.FFmpegError, ValueError) as error:
        raise ValueError(f"the sound of {source} cannot be decoded: {one_line(error)}") from error
    if not pieces:
        return np.zeros(0, np.float32), 0.0
    start = pieces[0][0]
    placed = [(round((time - start) * RATE), piece) for time, piece in pieces if time >= start]
    samples = np.zeros(max(place + len(piece) for place, piece in placed), np.float32)
    for place, piece in placed:
        samples[place : place + len(piece)] = piece
    return samples, start


def _read_pieces(source: Path) -> Iterator[tuple[float, Float[np.ndarray, " N"]]]:
    """Pieces of a video's sound at ``RATE``, and the time stamp of the first sample of each [s]; damage is skipped."""
    resamplers: dict[tuple[str, str, int], Any] = {}  # the format may change within a stream
    with av.open(str(source), options=READ_LOCAL_FILES) as container:
        end: float | None = None
        for frame in decoded(container, container.streams.audio[0]) if container.streams.audio else ():
            if frame.time is None:
                continue
            end = frame.time + MAX_SECONDS if end is None else end
            if frame.time > end:
                return
            form = frame.format.name, frame.layout.name, frame.sample_rate
            if form not in resamplers:
                resamplers[form] = av.AudioResampler(format="flt", layout="mono", rate=RATE)
            yield from ((float(out.time), out.to_ndarray()[0]) for out in resamplers[form].resample(frame))


def _onsets(samples: Float[np.ndarray, " N"]) -> Float[np.ndarray, "B T"]:
    """[B, T] the rise of the logarithmic power in each band, with a mean of 0 and a standard deviation of 1."""
    windows = np.lib.stride_tricks.sliding_window_view(samples, WINDOW)[::HOP]
    taper, power = np.hanning(WINDOW).astype(np.float32), []
    for begin in range(0, len(windows), CHUNK):
        spectrum = np.abs(np.fft.rfft(windows[begin : begin + CHUNK] * taper)) ** 2
        power.append(np.add.reduceat(spectrum[:, : BANDS[-1]], BANDS[:-1], axis=1).T)
    bands = np.concatenate(power, 1)
    floor = np.quantile(bands, FLOOR, axis=1, keepdims=True) + 1e-9 * bands.max()
    level = np.log1p(bands / floor)
    rise = np.maximum(np.diff(level, axis=1, prepend=level[:, :1]), 0.0)
    rise /= rise.std(1, keepdims=True) + 1e-9
    rise = np.minimum(rise, MAX_ONSET)
    return (rise - rise.mean(1, keepdims=True)).astype(np.float32)


@dataclass(frozen=True)
class Match:
    """Two recordings compared.

    Attributes:
        offset: Time of the second one's first frame after that of the first [s].
        ratio: Highest over next peak of the correlation.
    """

    offset: float
    ratio: float

    @property
    def is_certain(self) -> bool:
        """Whether the two hear the same."""
        return self.ratio >= MIN_RATIO


def compare(onsets: Sequence[Onsets]) -> dict[tuple[int, int], Match]:
    """The offsets of all pairs of recordings, by their indices, the smaller one first."""
    longest = max(o.values.shape[1] for o in onsets)
    size = 1 << (2 * longest - 1).bit_length()
    spectra = [np.fft.rfft(o.values, size) for o in onsets]
    energies = [np.concatenate([[0.0], np.cumsum((o.values.astype(np.float64) ** 2).sum(0))]) for o in onsets]
    found = {}
    for b in range(len(onsets)):
        for a in range(b):
            correlation = np.fft.irfft((spectra[a] * spectra[b].conj()).sum(0), size)
            lag, ratio = _peak(correlation, energies[a], energies[b])
            found[a, b] = Match(lag * HOP / RATE + onsets[a].start - onsets[b].start, ratio)
    return found


def _peak(
    correlation: Float[np.ndarray, " N"], a: Float[np.ndarray, " A"], b: Float[np.ndarray, " B"]
) -> tuple[float, float]:
    """The lag of the highest peak [values], and its height over the next peak's.

    Args:
        correlation: Circular correlation of a recording with another one; index k is the lag by which the other one
            begins later, or k − N.
        a, b: Sum of the squares of all values before each of theirs, and of all.
    """
    num_a, num_b = len(a) - 1, len(b) - 1
    lags = np.arange(-num_b + 1, num_a)
    begin, end = np.maximum(lags, 0), np.minimum(num_a, lags + num_b)
    energy = np.sqrt(np.maximum((a[end] - a[begin]) * (b[end - lags] - b[begin - lags]), 1e-12))
    # By chance, a coefficient of correlation of n values is as large as 1 over the root of n.
    score = correlation[lags] / energy * np.sqrt(end - begin)
    score[end - begin < MIN_OVERLAP * RATE / HOP] = 0.0
    best, width = int(score.argmax()), round(PEAK_WIDTH * RATE / HOP)
    others = score.copy()
    others[max(0, best - width) : best + width + 1] = 0.0
    # Without other lags to compare with, nothing says that this one is right.
    ratio = float(score[best] / others.max()) if score[best] > 0.0 and others.max() > 0.0 else 0.0
    before, peak, after = score[[max(best - 1, 0), best, min(best + 1, len(score) - 1)]]
    bend = before - 2.0 * peak + after
    return float(lags[best]) + (0.5 * float((before - after) / bend) if bend < 0.0 else 0.0), ratio
