"""Which nodes get no more cells."""

import pytest

from warpgs.sweep.nodes import MAX_ROW, Nodes


def fail(nodes, node):
    for k in range(MAX_ROW):
        nodes.note(f"{node}{k}", node, "full")


def test_a_node_that_is_excluded_stays_so_when_the_last_other_one_fails_too():
    nodes = Nodes()
    fail(nodes, "b")
    assert nodes.exclude(["a", "b"]) == ["node b gets no more cells: b0, b1 failed on it in a row (full)"]
    fail(nodes, "a")
    assert nodes.exclude(["a", "b"]) == []
    assert nodes.avoided_by("new") == {"b"}


@pytest.mark.parametrize("alive", ["abc", "cba", "bca"])
def test_where_all_nodes_fail_at_once_their_order_does_not_matter_and_the_last_by_name_is_left(alive):
    nodes = Nodes()
    for node in alive:
        fail(nodes, node)
    assert [line[:6] for line in nodes.exclude(list(alive))] == ["node a", "node b"]
    assert nodes.avoided_by("new") == {"a", "b"}
