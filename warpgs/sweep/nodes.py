"""Which nodes of a cluster get which cells: a node that fails them must not take all. Knows nothing of Ray."""

from collections.abc import Collection

MAX_ROW = 2
"""A node gets no more cells when this many failed on it in a row, as on a full disk."""


class Nodes:
    """Where cells failed, and which nodes follow from it that a cell avoids.

    A cell that failed on two nodes is at fault itself, and says nothing about these nodes. A node that is not known (an
    empty id) is neither blamed nor avoided. Cells never avoid every node.
    """

    def __init__(self) -> None:
        self._rows: dict[str, dict[str, str]] = {}  # by node: the errors of cells that failed on it in a row
        self._failed_on: dict[str, set[str]] = {}  # by cell
        self._excluded: list[str] = []
        self._others: frozenset[str] = frozenset()

    def note(self, cell: str, node: str, error: str | None) -> None:
        """Takes note of how an attempt at a cell ended; without an error, it succeeded."""
        if error is None:
            self._rows.pop(node, None)
        elif node:
            failed_on = self._failed_on.setdefault(cell, set())
            failed_on.add(node)
            self._rows.setdefault(node, {})[cell] = error
            if len(failed_on) > 1:
                for row in self._rows.values():
                    row.pop(cell, None)

    def exclude(self, alive: Collection[str]) -> list[str]:
        """Decides which nodes get no more cells; returns a line about each node for which that has changed.

        Args:
            alive: Every node on which a cell can run.
        """
        before, self._excluded = self._excluded, []
        suspects = [node for node in alive if len(self._rows.get(node, ())) >= MAX_ROW]
        for node in sorted(suspects, key=lambda node: (node not in before, node)):  # one that is excluded stays so
            if set(alive) - {*self._excluded, node}:
                self._excluded.append(node)
        self._others = frozenset(alive) - set(self._excluded)
        lines = []
        for node in self._excluded:
            if node not in before:
                *_, last = row = self._rows[node]
                lines.append(
                    f"node {node[:8]} gets no more cells: {', '.join(row)} failed on it in a row ({row[last]})"
                )
        again = [node for node in before if node in self._others]
        return lines + [f"node {node[:8]} gets cells again" for node in again]

    def avoided_by(self, cell: str) -> frozenset[str]:
        """The nodes that a cell avoids: those that are excluded, and one where it failed, if there is another."""
        failed_on = self._failed_on.get(cell, set())
        return frozenset(self._excluded) | (failed_on if self._others - failed_on else frozenset())
