"""Directions and lens of a camera that only turns, from matches between its frames.

A static surface on the ray r = (x, y, 1) of a pixel in frame a is in frame b where the lens projects R_b R_aᵀ r.
Rotations of single pairs (``data.turning``), chained along the pairs with most matches, are the start. Then all
rotations, the focal length and the radial distortion together minimise the distances from the matched positions, under
a Cauchy loss, so that matches on dynamic objects do not count.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial.transform import Rotation
from torch import Tensor

from warpgs.data.lens import Lens
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.data.turning import Matches, find_turning, fit_rotation
from warpgs.least_squares import Problem, minimize

from .recovered import Cameras, NoCamerasError

MAX_MATCHES = 20
"""Matches of a pair that are used, evenly spread over them; 60 change the focal length by less than 0.1 %."""

MIN_MATCHES = 15
"""Minimum number of matches of a pair that one rotation explains."""

TOLERANCE = 2.0
"""Distance of a match from where its rotation moves it that counts as explained [px]."""

MIN_EXPLAINED = 0.5
"""Fraction of the matches that must be explained: dynamic objects have others."""

MIN_PLACED = 0.5
"""Fraction of the frames that must be connected by matches."""

SCALE = 1.0
"""Distance at which the weight of a match is half [px]."""

MAX_STEPS, MIN_DECREASE = 60, 1e-7
"""Maximum number of Levenberg-Marquardt steps, and the relative decrease of the loss below which they end."""

FOLDED = 1e6
"""Distance that stands for all with a lens that folds back [px]."""

STEP = 1e-6
"""Step of numerical derivatives."""

Pair = tuple[int, int]


def find_directions(
    names: Sequence[str], pairs: Mapping[Pair, Matches], lens: Lens, *, finds_focal: bool, finds_distortion: bool
) -> Cameras:
    """The cameras of frames of a camera that only turns, all at the origin; without points.

    Args:
        names: Names of the frames.
        pairs: Matches of pairs of frames, by their indices.
        lens: The lens of the frames, known as far as it is not found here.
        finds_focal: Whether to find the focal length.
        finds_distortion: Whether to find the first coefficient of radial distortion.

    Raises:
        NoCamerasError: If the frames show too little in common, the camera does not only turn, or the lens that is
            found is impossible.
    """
    usable = {pair: matches for pair, matches in pairs.items() if len(matches[0]) >= MIN_MATCHES}
    if finds_focal:
        lens = _with_focal([*usable.values()], lens)
    relative = {pair: found for pair, matches in usable.items() if (found := _relative(matches, lens)) is not None}
    rotations = _chained(len(names), relative)
    placed = [k for k, rotation in enumerate(rotations) if rotation is not None]
    if len(placed) < max(MIN_PLACED * len(names), 2):
        raise NoCamerasError(
            f"only {len(placed)} of {len(names)} frames are connected by rotations: the camera moves to other places "
            "(--camera moving), turns too fast, or too much else moves"
        )
    index = {k: j for j, k in enumerate(placed)}
    used = [(index[a], index[b], *_thinned(usable[a, b])) for a, b in relative if a in index and b in index]
    problem = _Problem.of(used, lens, finds_focal, finds_distortion)
    directions, lens = problem.solve(np.array([r.as_matrix() for r in rotations if r is not None]))
    error = _checked_error(problem.residuals(directions, lens))
    _check_lens(lens)
    poses = np.concatenate([directions, np.zeros((len(placed), 3, 1))], 2)
    return Cameras([names[k] for k in placed], lens, poses, np.zeros((0, 3)), error, 0.0)


def _checked_error(residuals: Float[np.ndarray, "M 2"]) -> float:
    """Mean distance of the matches that the rotations explain, if these are enough [px]."""
    errors = np.linalg.norm(residuals, axis=1)
    explained = errors < TOLERANCE
    if explained.mean() < MIN_EXPLAINED:
        raise NoCamerasError(
            f"the camera does not only turn: rotations explain {explained.mean():.0%} of the matches between frames, "
            f"less than {MIN_EXPLAINED:.0%}; use --camera moving"
        )
    return float(errors[explained].mean())


def _check_lens(lens: Lens) -> None:
    """Refuses a lens that no camera has; what the matches leave open can become anything."""
    try:
        _ = lens.checked().distortion
    except ValueError as error:
        raise NoCamerasError(
            f"the matches determine no possible lens: {error}; give the focal length (--focal PX) or the whole lens "
            "(--intrinsics FILE), or omit distortion (--lens SIMPLE_PINHOLE)"
        ) from error


def _with_focal(pairs: Sequence[Matches], lens: Lens) -> Lens:
    """The lens with the focal length that explains most as turning."""
    turning = find_turning(pairs, (lens.width, lens.height))
    if turning is None or turning.stands_still:
        raise NoCamerasError(
            "the camera hardly turns, or the frames show too little in common to find its focal length: give it "
            "(--focal PX), or use --camera still"
        )
    return dataclasses.replace(lens, focal=(turning.focal, turning.focal))


def _relative(matches: Matches, lens: Lens) -> tuple[Rotation, int] | None:
    """The rotation of a pair and the number of matches that it explains; None if they are too few."""
    rotation, errors = fit_rotation(lens.unit_rays(matches[0]), lens.unit_rays(matches[1]), TOLERANCE / lens.focal[0])
    count = int((errors < 2.0 * TOLERANCE / lens.focal[0]).sum())
    return (Rotation.from_matrix(rotation), count) if count >= MIN_MATCHES else None


def _chained(count: int, relative: Mapping[Pair, tuple[Rotation, int]]) -> list[Rotation | None]:
    """The rotation of each frame along the pairs with most matches; None where no pair leads."""
    first, second = np.array([*relative], int).reshape(-1, 2).T
    weights = np.array([float(number) for _, number in relative.values()])
    graph = sparse.csr_matrix((-weights, (first, second)), shape=(count, count))
    tree = minimum_spanning_tree(graph)
    _, component = connected_components(tree, directed=False)
    root = int(np.flatnonzero(component == np.bincount(component).argmax())[0])
    order, parents = breadth_first_order(tree, root, directed=False)
    rotations: list[Rotation | None] = [None] * count
    rotations[root] = Rotation.identity()
    for k in order[1:].tolist():
        parent = rotations[parents[k]]
        assert parent is not None
        pair = (int(parents[k]), k)
        rotations[k] = relative[pair][0] * parent if pair in relative else relative[pair[::-1]][0].inv() * parent
    return rotations


def _thinned(matches: Matches) -> Matches:
    chosen = evenly_spaced_indices(len(matches[0]), MAX_MATCHES)
    return matches[0][chosen], matches[1][chosen]


@dataclass(frozen=True)
class _Problem:
    """The least-squares problem.

    Attributes:
        a, b: [M] index of the frames of each match.
        seen_a, seen_b: [M, 2] its positions in them [px].
        lens: The lens to start from.
        free: What is found of the lens: "focal", "distortion".
    """

    a: np.ndarray
    b: np.ndarray
    seen_a: Float[np.ndarray, "M 2"]
    seen_b: Float[np.ndarray, "M 2"]
    lens: Lens
    free: tuple[str, ...]

    @staticmethod
    def of(used: Sequence[tuple], lens: Lens, finds_focal: bool, finds_distortion: bool) -> "_Problem":
        a, b = (np.concatenate([np.full(len(row[2]), row[side]) for row in used]) for side in (0, 1))
        seen_a, seen_b = (np.concatenate([row[side] for row in used]) for side in (2, 3))
        free = ("focal",) * finds_focal + ("distortion",) * finds_distortion
        return _Problem(a, b, seen_a, seen_b, lens, free)

    def solve(self, start: Float[np.ndarray, "F 3 3"]) -> tuple[Float[np.ndarray, "F 3 3"], Lens]:
        """The rotations and the lens that fit best. The first frame keeps its direction."""

        def state(x: Tensor) -> tuple[np.ndarray, Lens]:
            turns, changes = np.split(x.numpy(), [3 * len(start) - 3])
            turns = np.concatenate([np.zeros((1, 3)), turns.reshape(-1, 3)])
            return Rotation.from_rotvec(turns).as_matrix() @ start, self._lens(changes)

        problem = Problem(
            residuals=lambda x: torch.from_numpy(self.residuals(*state(x))),
            loss=lambda residuals: float((residuals.square().sum(1) / SCALE**2).log1p().sum()),
            normal_equations=lambda x, residuals: self._normal_equations(*state(x), x.numpy(), residuals.numpy()),
        )
        unchanged = torch.zeros(3 * len(start) - 3 + len(self.free), dtype=torch.float64)
        return state(minimize(problem, unchanged, MAX_STEPS, MIN_DECREASE))

    def residuals(self, rotations: Float[np.ndarray, "F 3 3"], lens: Lens) -> Float[np.ndarray, "M 2"]:
        """[M, 2] distances of the positions in b from where the rotations move those in a [px].

        Of a lens that folds back, which no camera has, they are very large.
        """
        try:
            _ = lens.distortion
        except ValueError:
            return np.full_like(self.seen_b, FOLDED)
        return self._project(self._turned(rotations, lens), lens) - self.seen_b

    def _lens(self, changes: np.ndarray) -> Lens:
        values = dict(zip(self.free, changes.tolist(), strict=True))
        factor = float(np.exp(values.get("focal", 0.0)))
        focal = self.lens.focal[0] * factor, self.lens.focal[1] * factor
        k1, *others = self.lens.coefficients or (0.0,)
        return dataclasses.replace(self.lens, focal=focal, coefficients=(k1 + values.get("distortion", 0.0), *others))

    def _turned(self, rotations: np.ndarray, lens: Lens) -> Float[np.ndarray, "M 3"]:
        inward = np.einsum("mji,mj->mi", rotations[self.a], lens.unit_rays(self.seen_a))
        return np.einsum("mij,mj->mi", rotations[self.b], inward)

    @staticmethod
    def _project(rays: Float[np.ndarray, "M 3"], lens: Lens) -> Float[np.ndarray, "M 2"]:
        depth = np.maximum(rays[:, 2], 0.05)  # no ray at 90° from the axis
        return lens.image(rays[:, 0] / depth, rays[:, 1] / depth).T

    def _normal_equations(
        self, rotations: np.ndarray, lens: Lens, x: np.ndarray, residuals: Float[np.ndarray, "M 2"]
    ) -> tuple[Float[Tensor, "P P"], Float[Tensor, " P"]]:
        """Those of ``least_squares.Problem``, with the weights of Cauchy's loss."""
        jacobian = self._jacobian(rotations, lens, x)
        weights = np.repeat(1.0 / (1.0 + (residuals**2).sum(1) / SCALE**2), 2)
        weighted = jacobian.multiply(weights[:, None]).tocsr()
        return torch.from_numpy((weighted.T @ jacobian).toarray()), torch.from_numpy(weighted.T @ residuals.ravel())

    def _jacobian(self, rotations: np.ndarray, lens: Lens, x: np.ndarray) -> sparse.csr_matrix:
        """[2 M, len(x)]: turning b by ω moves the ray X by ω × X, and turning a by ω by −(R_b R_aᵀ ω) × X."""
        rays, rows = self._turned(rotations, lens), 2 * len(self.a)
        steps = STEP * np.eye(3)
        by_ray = np.stack([self._project(rays + e, lens) - self._project(rays - e, lens) for e in steps], 2) / (
            2 * STEP
        )
        cross = np.stack([np.cross(e, rays) for e in np.eye(3)], 2)
        by_b = by_ray @ cross
        by_a = -by_b @ (rotations[self.b] @ rotations[self.a].transpose(0, 2, 1))
        entries = []
        for frames, values in ((self.a, by_a), (self.b, by_b)):
            row = np.arange(rows).reshape(-1, 2, 1)
            column = (3 * frames - 3)[:, None, None] + np.arange(3)
            entries.append([np.broadcast_to(part, values.shape).ravel() for part in (row, column, values)])
        offset = len(x) - len(self.free)
        for j in range(len(self.free)):
            ahead, behind = x[offset:].copy(), x[offset:].copy()
            ahead[j], behind[j] = ahead[j] + STEP, behind[j] - STEP
            ends = [self.residuals(rotations, self._lens(change)) for change in (ahead, behind)]
            column = np.full(rows, offset + j)
            entries.append([np.arange(rows), column, ((ends[0] - ends[1]) / (2 * STEP)).ravel()])
        row, column, values = (np.concatenate(part) for part in zip(*entries, strict=True))
        kept = column >= 0  # the first frame is fixed
        return sparse.csr_matrix((values[kept], (row[kept], column[kept])), shape=(rows, len(x)))
