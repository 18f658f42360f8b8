"""Networks that prepare can use, and their weights: found on this machine, never downloaded."""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from warpgs.command_line.version import install_command
from warpgs.files import read_json, require_file

MAX_BYTES = 8 << 30
"""Maximum size of a file of weights [bytes]; the largest network has a fifth of that."""


@dataclass(frozen=True)
class Network:
    """A network of the transformers package.

    Attributes:
        option: Command-line option that selects it.
        title: Its name in messages.
        model_type: ``model_type`` in its config.json.
        model: Name of its class.
        names: Names of its weights in the Hugging Face cache, best first.
    """

    option: str
    title: str
    model_type: str
    model: str
    names: tuple[str, ...]


SAM2 = Network(
    "--masks sam2",
    "SAM 2",
    "sam2_video",
    "Sam2VideoModel",
    tuple(f"facebook/sam2.1-hiera-{size}" for size in ("large", "base-plus", "small", "tiny")),
)
DEPTH_ANYTHING = Network(
    "--depth anything",
    "Depth Anything V2",
    "depth_anything",
    "DepthAnythingForDepthEstimation",
    tuple(f"depth-anything/Depth-Anything-V2-{size}-hf" for size in ("Large", "Base", "Small")),
)


def find_weights(network: Network | None, folder: Path | None) -> Path | None:
    """The folder with config.json and weights of a network; None without a network.

    Args:
        network: The network.
        folder: Searched, with its subfolders; the Hugging Face cache if None.

    Raises:
        ImportError: If the transformers package is missing.
        ValueError: If the weights are not found, which the message says how to get, or a file is not a regular one.
    """
    if network is None:
        return None
    if find_spec("transformers") is None:
        raise ImportError(f"{network.option} needs the package transformers: {install_command('networks')}")
    folders = _cached(network) if folder is None else [folder, *sorted(p for p in folder.glob("*") if p.is_dir())]
    found = next((p for p in folders if _model_type(p) == network.model_type and any(p.glob("*.safetensors"))), None)
    if found is None:
        raise ValueError(
            f"{network.option} needs the weights of {network.title}, which are not in "
            f"{folder or 'the Hugging Face cache'}: get them once with `hf download {network.names[0]}`, or name their "
            "folder (config.json and model.safetensors) with --weights"
        )
    for path in found.iterdir():
        if path.suffix in (".json", ".safetensors"):
            require_file(path, MAX_BYTES)
    return found


def _cached(network: Network) -> list[Path]:
    from huggingface_hub import try_to_load_from_cache  # installed with transformers

    found = [try_to_load_from_cache(name, "config.json") for name in network.names]
    return [Path(path).parent for path in found if isinstance(path, str)]


def _model_type(folder: Path) -> str | None:
    try:
        return read_json(folder / "config.json").get("model_type")
    except ValueError:
        return None
