"""The order in which the nodes of a graph are eliminated: nested dissection into fronts.

A small set of nodes, the separator, splits a graph in two parts that are not joined. Eliminated after both of them, it
keeps them from filling in between each other; each part is split again. The nodes eliminated together, and those that
they are joined with by then, are a front: a dense matrix, so that the work is few large products.
Sources: George, "Nested dissection of a regular finite element mesh", 1973; Duff and Reid, "The multifrontal solution
of indefinite sparse symmetric linear equations", 1983.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

# Parts this small are dense fronts: less work than the calls for splitting them further.
_LEAF_NODES = 40
# A separator leaves at least this share of a part on either side.
_BALANCE = 0.3


@dataclass
class FrontNodes:
    """Nodes that are eliminated together, those they are joined with then, and the fronts to be done before."""

    eliminated: list[int]
    children: list[int]
    boundary: list[int] = field(default_factory=list)


def dissect(num_nodes: int, pairs: Iterable[tuple[int, int]]) -> list[FrontNodes]:
    """Fronts that eliminate all nodes, children before their parents. pairs: the joined nodes, each pair once."""
    neighbours: list[list[int]] = [[] for _ in range(num_nodes)]
    for a, b in pairs:
        neighbours[a].append(b)
        neighbours[b].append(a)
    fronts: list[FrontNodes] = []
    _split(list(range(num_nodes)), neighbours, fronts)

    front_of = [0] * num_nodes
    for index, front in enumerate(fronts):
        for node in front.eliminated:
            front_of[node] = index
    for index, front in enumerate(fronts):
        touched = {other for node in front.eliminated for other in neighbours[node]}
        touched.update(*(fronts[child].boundary for child in front.children))
        later = (node for node in touched if front_of[node] > index)
        front.boundary = sorted(later, key=lambda node: (front_of[node], node))
    return fronts


def _split(part: list[int], neighbours: list[list[int]], fronts: list[FrontNodes]) -> list[int]:
    """Append the fronts of a part of the graph; returns those that no other one of the part follows."""
    roots: list[int] = []
    pool: list[int] = []
    inside = set(part)
    for start in part:
        if start not in inside:
            continue
        levels = _levels(start, neighbours, inside)
        component = [node for level in levels for node in level]
        if len(component) > _LEAF_NODES:
            separator, halves = _separator(_levels(component[-1], neighbours, inside))
            children = [root for half in halves if half for root in _split(half, neighbours, fronts)]
            fronts.append(FrontNodes(separator, children))
            roots.append(len(fronts) - 1)
        else:
            pool += component
        inside.difference_update(component)
        if len(pool) > _LEAF_NODES:
            pool = _append_leaf(pool, fronts, roots)
    if pool:
        _append_leaf(pool, fronts, roots)
    return roots


def _append_leaf(nodes: list[int], fronts: list[FrontNodes], roots: list[int]) -> list[int]:
    fronts.append(FrontNodes(nodes, []))
    roots.append(len(fronts) - 1)
    return []


def _levels(start: int, neighbours: list[list[int]], inside: set[int]) -> list[list[int]]:
    """The nodes reached from `start` inside a part, by their distance from it."""
    levels, seen = [[start]], {start}
    while levels[-1]:
        following = []
        for node in levels[-1]:
            for other in neighbours[node]:
                if other not in seen and other in inside:
                    seen.add(other)
                    following.append(other)
        levels.append(following)
    return levels[:-1]


def _separator(levels: list[list[int]]) -> tuple[list[int], tuple[list[int], list[int]]]:
    """The smallest level near the middle, or the middle one, and what lies on either side of it."""
    total = sum(len(level) for level in levels)
    best, best_size, before = 0, total + 1, 0
    for index, level in enumerate(levels):
        after = total - before - len(level)
        middle = before <= total / 2 and after <= total / 2
        size = len(level) if min(before, after) >= _BALANCE * total else total if middle else total + 1
        if size < best_size:
            best, best_size = index, size
        before += len(level)
    below = [node for level in levels[:best] for node in level]
    above = [node for level in levels[best + 1 :] for node in level]
    return levels[best], (below, above)
