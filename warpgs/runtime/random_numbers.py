"""Random numbers that do not depend on what was drawn before, so that a resumed run has the same ones."""

import hashlib

import torch


def random_numbers(
    seed: int, purpose: str, iteration: int, rollbacks: int, device: torch.device | str = "cpu"
) -> torch.Generator:
    """The generator for a purpose at an iteration, after a number of returns to a checkpoint."""
    words = f"{seed} {purpose} {iteration} {rollbacks}"
    digest = hashlib.blake2b(words.encode(), digest_size=7).digest()
    return torch.Generator(device).manual_seed(int.from_bytes(digest, "big"))
