"""Stable sort of pairs by their keys."""


def sort_pairs(keys: list[int], values: list[int]) -> tuple[list[int], list[int]]:
    order = sorted(range(len(keys)), key=lambda k: keys[k])  # Python's sort is stable
    return [keys[k] for k in order], [values[k] for k in order]
