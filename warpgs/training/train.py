"""A training run from start to end: run folder, training, evaluation."""

import contextlib
import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from warpgs.captures.check import require_fit
from warpgs.captures.opening import open_capture
from warpgs.command_line.interrupt import Interrupt
from warpgs.config import Device, TrainConfig, extended, scaled
from warpgs.data.capture import Capture
from warpgs.errors import command, counted, is_out_of_memory
from warpgs.evaluation.evaluate import check_views
from warpgs.evaluation.evaluate_run import evaluate_run
from warpgs.evaluation.held_out import HeldOut
from warpgs.evaluation.lpips import locate
from warpgs.files import write_json
from warpgs.initialization.prepare_start import prepare_again, prepare_start
from warpgs.model.poses import PoseCorrections
from warpgs.ops.mlp import check_half_precision
from warpgs.runs import preview
from warpgs.runs.config_file import read_config, require_recorded, require_resumable, write_config, write_start
from warpgs.runs.logger import TrainingLogger, ignore
from warpgs.runs.preview import Previewer
from warpgs.runs.progress import Callback
from warpgs.runs.run import MASK_TRIAL, Run, locked_new_folder
from warpgs.runtime import ranks
from warpgs.runtime.devices import choose_device
from warpgs.runtime.machine import described, kernels_note

from .mask_trial import with_trusted_masks
from .trainer import Trainer

Log = Callable[[str], None]
"""Receives lines for the user, such as ``print``."""

BEFORE = "stopped before the first iteration, nothing was saved: give the same command again"
"""What Ctrl-C ends with while a training is prepared."""

BEFORE_NEXT = "stopped before the next iteration, the run is as it was: give the same command again"
"""What Ctrl-C ends with while a training that goes on is prepared."""

FINISHED = "training is finished ({} iterations), and the run is evaluated again; a larger --iterations trains on"


class TrainingInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM stopped the training after an iteration, and a checkpoint of it was saved.

    ``lost`` says what was stopped after that iteration and begins anew, for the message.

    Attributes:
        folder (Path): Run folder; ``TrainConfig(resume=folder)`` continues it.
        iteration (int): Iterations done.
        num_iterations (int): Those of the whole run.
    """

    def __init__(self, folder: Path, iteration: int, num_iterations: int, lost: str = "") -> None:
        goes_on = command("train", "--resume", folder) + (f", which begins {lost} anew" if lost else "")
        super().__init__(f"stopped after iteration {iteration} of {num_iterations}; continue with {goes_on}")
        self.folder, self.iteration, self.num_iterations = folder, iteration, num_iterations


def train(config: TrainConfig, log: Log | None = None, callbacks: Sequence[Callback] = ()) -> Run:
    """Trains and evaluates a run.

    ``train(TrainConfig(data=Path("nerfds/as")), log=print).trained_scene()`` trains as the command line does.

    SIGTERM and the first Ctrl-C let the current iteration finish and save a checkpoint; the second Ctrl-C stops at
    once.

    Under torchrun its processes train one scene together (``runtime.ranks``). The first one writes the run folder and
    evaluates; in the others, ``log`` and ``callbacks`` are not called, and ``train`` returns when training has ended.

    Args:
        config: The config. Its defaults are the preset best; ``dataclasses.replace`` changes one of
            ``warpgs.config.presets.PRESETS``. ``resume`` continues a run with its own config, for ``iterations`` in
            total if that is given.
        log: Receives lines for the user; if None, nothing is printed.
        callbacks: Each is called with a ``Progress`` every 50 iterations and before checkpoints; if one returns true,
            training ends there, with a checkpoint. Their time does not count as training time.

    Returns:
        The finished run; its folder holds checkpoints, metrics.json, views.csv, images/ and time.mp4.

    Raises:
        TrainingInterrupted: After the first Ctrl-C.
        UnfitCaptureError: If the capture has errors that would make training useless.
        ValueError: If the run, its capture or an option cannot be used, or the loss is repeatedly not finite.
        OSError: If a file cannot be written.
        SystemExit: Under torchrun, if another of its processes has failed and reports why.
    """
    with contextlib.ExitStack() as locks:
        with ranks.joined():
            is_first = ranks.is_first()
            log = log if is_first else None
            trainer = make_trainer(config, log, locks)
            _describe(trainer, log or ignore)
            is_changed = config.resume is not None and (config.iterations is not None or config.data is not None)
            _train(trainer, is_changed, callbacks, quiet=log is None)
        if is_first:
            _evaluate(trainer, log)
    return Run(trainer.run, trainer.config)


def _evaluate(trainer: Trainer, log: Log | None) -> None:
    """Evaluates what was trained and logs the results; says how to evaluate later if it is interrupted or fails."""
    quiet, log, config = log is None, log or ignore, trainer.config
    weights = (config.lpips, config.lpips_net)  # config.json has others if they were given with --resume
    if trainer.views.poses is not None:
        _describe_corrections(trainer.views.poses, log)
    capture = trainer.capture.assuming("masks")  # evaluation needs the true masks
    if capture.val:
        # Without a terminal, there is no progress bar for minutes.
        log(f"evaluating {counted(len(capture.val), 'view')}")
    lpips = [] if config.lpips is None else ["--lpips", str(config.lpips), "--lpips-net", config.lpips_net]
    later = f"run it with {command('eval', trainer.run, *lpips)}"
    try:
        log(evaluate_run(trainer.run, capture, weights, config.device, quiet))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"training is done, evaluation stopped; {later}") from None
    except Exception:  # lack of memory, too, whose advice is about training
        log(f"training is done and saved, but evaluation failed with the error below; once that is solved, {later}")
        raise
    files = "metrics.json, views.csv, images/ and time.mp4" if capture.val else "metrics.json and time.mp4"
    log(f"{files} are in {trainer.run}; {command('view', trainer.run)} shows the scene")


def _train(trainer: Trainer, is_changed: bool, callbacks: Sequence[Callback], quiet: bool) -> None:
    """Trains in the run folder, which is locked; raises TrainingInterrupted after Ctrl-C."""
    num_iterations, is_first = trainer.protocol.num_iterations, ranks.is_first()
    run = Run(trainer.run, trainer.config)
    events = run.folder / "events" if is_first else None
    with (
        Interrupt() as interrupt,
        TrainingLogger(events, num_iterations, trainer.iteration, quiet, trainer.protocol.remaining_cost) as logger,
    ):
        if is_first:
            if is_changed:
                write_config(run.folder, run.config)
            trainer.callbacks = (*callbacks, HeldOut(logger), Previewer(run.folder, logger), run.require_present)
        try:
            finished = trainer.train(logger, interrupt)
        except Exception as error:
            if is_out_of_memory(error):
                logger.log(_too_many(trainer))
            raise
        finally:
            if is_first:
                preview.remove(run.folder)
        trainer.step.release_graphs()
        interrupted = ranks.any_rank(not finished and interrupt.requested)
    if interrupted:
        is_fit_lost = trainer.config.schedule.fit_motion and trainer.iteration == trainer.protocol.stage1.start
        lost = "the fit of what moves" if is_fit_lost else ""
        raise TrainingInterrupted(run.folder, trainer.iteration, num_iterations, lost)


def _too_many(trainer: Trainer) -> str:
    """What to say of the scene when it has become too large for the memory."""
    scene, iteration = trainer.scene, trainer.iteration + 1
    numbers = f"{len(scene.static):,} static and {len(scene.dynamic):,} dynamic Gaussians"
    return f"memory ran out in iteration {iteration}, with {numbers}; --densify.max-gaussians limits their sum"


def _describe(trainer: Trainer, log: Log) -> None:
    """Logs what is trained where."""
    num_views = len(trainer.views)
    config, name = trainer.config, trainer.capture.name
    layout = "" if config.data is None else f" (read as {trainer.capture.layout})"
    together = "" if ranks.num_ranks() == 1 else f", {ranks.num_ranks()} views per iteration"
    resumed = f", after iteration {trainer.iteration} of {trainer.protocol.num_iterations}" * (trainer.iteration > 0)
    views = counted(num_views, "view")
    log(f"{name}{layout}: {views}, on {described(config.device)}{together}, into {trainer.run}{resumed}")
    if config.device == "cuda":
        log(kernels_note("cuda"))
    for note in trainer.notes:
        log(note)


def _describe_corrections(poses: PoseCorrections, log: Log) -> None:
    """Logs how far the training cameras were moved."""
    turned, shifted = poses.angles().rad2deg(), 100.0 * poses.shifts()
    log(
        f"camera poses were corrected by {turned.median():.2f}° and {shifted.median():.2f} % of the view size "
        f"(medians; at most {turned.max():.2f}° and {shifted.max():.2f} %)"
    )


def make_trainer(config: TrainConfig, log: Log | None = None, locks: contextlib.ExitStack | None = None) -> Trainer:
    """A trainer for a new run, or one that continues ``config.resume`` from its newest checkpoint.

    The run folder is locked before anything is written into it.

    Args:
        config: The config.
        log: Receives warnings about the capture; if None, nothing is printed.
        locks: Holds the lock until it is closed; if None, the lock ends when the trainer is made.

    Raises:
        UnfitCaptureError: If the capture has errors that would make training useless.
        ValueError: If the run, its capture or an option cannot be used.
        OSError: If the run folder cannot be written.
    """
    with contextlib.ExitStack() as until_made:
        make = _begun if config.resume is None else _continued
        try:
            return make(config, log or ignore, log is None, until_made if locks is None else locks)
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(str(stop) or (BEFORE if config.resume is None else BEFORE_NEXT)) from None


def _begun(config: TrainConfig, log: Log, quiet: bool, locks: contextlib.ExitStack) -> Trainer:
    """The trainer of a new run."""
    asked = config
    config = scaled(dataclasses.replace(config, device=_own_device(config.device)))
    _require_usable(config)
    capture = _checked(open_capture(config, quiet), config, log)
    folder = str(locks.enter_context(locked_new_folder(config, capture))) if ranks.is_first() else ""
    _read_evaluation_frames(capture, config, quiet)
    if config.device == "cpu" and config.preset in ("best", "paper"):
        log(f"the preset {config.preset} is for a GPU; {_cpu_advice(config)}")
    config, trial = with_trusted_masks(config, capture, log, quiet)
    trainer = Trainer(prepare_start(config, capture), Path(ranks.text_of_first(folder)))
    if ranks.is_first():
        # Last: the folder of a run that is refused before is removed again.
        run = Run.create(trainer.run, trainer.config)
        write_start(run.folder, asked, trainer.notes)
        if trial:
            write_json(trainer.run / MASK_TRIAL, trial)
    return trainer


def _require_usable(config: TrainConfig) -> None:
    """Raises ValueError if half precision may be wrong, or, now and not after training, for a wrong folder of LPIPS."""
    if config.model.half and config.device == "cuda":
        check_half_precision()
    locate(config.lpips, config.lpips_net)


def _cpu_advice(config: TrainConfig) -> str:
    """What to train with on the CPU; --factor 2 only if the capture has, or can be read at, half the size."""
    try:
        open_capture(dataclasses.replace(config, factor=2), quiet=True)
    except ValueError:
        return "on a CPU, use --preset patient, or quick, which is faster"
    return "on two CPU cores, --preset patient --factor 2 takes about 10 minutes, and quick 2"


def _continued(config: TrainConfig, log: Log, quiet: bool, locks: contextlib.ExitStack) -> Trainer:
    """The trainer of a run, restored from its newest checkpoint."""
    assert config.resume is not None
    folder = config.resume
    found = Run(folder, read_config(folder))  # before it is locked: nothing is written into other folders
    require_resumable(folder)
    if ranks.is_first():
        locks.enter_context(found.lock())
    saved = extended(read_config(folder), config.iterations)
    given = {name: getattr(config, name) for name in ("data", "lpips") if getattr(config, name)}
    if config.lpips is not None:
        given["lpips_net"] = config.lpips_net
    run = Run(folder, dataclasses.replace(saved, **given, device=_own_device(config.device or saved.device)))
    _require_usable(run.config)
    capture = _checked(run.open_capture(quiet), run.config, log)
    require_recorded(folder, any(camera.distortion is not None for camera in capture.cameras.values()))
    _read_evaluation_frames(capture, run.config, quiet)
    trainer = Trainer(prepare_again(run.config, capture), run.folder)
    trainer.restore_newest(log)
    if trainer.iteration == trainer.protocol.num_iterations:
        log(FINISHED.format(trainer.iteration))
    return trainer


def _own_device(asked: Device | None) -> Device:
    """The type of device to train on; on GPUs each rank of torchrun uses its own."""
    device = choose_device(asked)
    ranks.use_device(device)
    return device


def _checked(capture: Capture, config: TrainConfig, log: Log) -> Capture:
    """The capture, if it is fit to train on and the same on all ranks of torchrun, as the options are."""
    require_fit(capture.assuming(config.assumption), log)
    if ranks.num_ranks() == 1:
        return capture
    ranks.require_same("the options", json.dumps(dataclasses.asdict(config), default=str).encode())
    content = (sorted(capture.cameras.items()), capture.points, capture.train, capture.val)
    ranks.require_same("the capture", _as_bytes(content))
    return capture


def _as_bytes(value: Any) -> bytes:
    """All that a value consists of, every field of dataclasses and every bit of tensors included."""
    if isinstance(value, Tensor):
        return repr(value.shape).encode() + value.cpu().numpy().tobytes()
    if dataclasses.is_dataclass(value):
        return _as_bytes([getattr(value, field.name) for field in dataclasses.fields(value)])
    if isinstance(value, list | tuple):
        return b"(%b)" % b",".join(map(_as_bytes, value))
    return repr(value).encode()


def _read_evaluation_frames(capture: Capture, config: TrainConfig, quiet: bool) -> None:
    """Raises ValueError if the evaluation will fail to read a file: when training is done, it is too late."""
    if ranks.is_first():  # which evaluates
        check_views(capture, quiet)
    ranks.any_rank(False)  # a lost rank is found here: the others would prepare a start for nothing
