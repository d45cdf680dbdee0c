"""Vault whose treasure lies behind a locked door: nothing on the way there is rewarded."""

from __future__ import annotations

from typing import NamedTuple

MAP = """
########################################
#S.......#.......#.........#...........#
#........#..^^...#..^^^....#...^^......#
#..^^....#..^^......^^.....#...^^...K..#
#..^^............#.........#...........#
#........#.......#....^^.......^^......#
###.###########.#####.##########.#######
#.........#.........^^.....#...........#
#...^^....#..^^.....^^.....D....^^.....#
#...^^.......^^............#....^^...T.#
#.........#................#...........#
########################################
""".split()
MOVES = ((0, -1), (0, 1), (-1, 0), (1, 0))
KEY, TREASURE = 1, 10  # what they are worth


class State(NamedTuple):
    """Place of the player in the vault, and the key, if it has it."""

    x: int = 1
    y: int = 1
    key: bool = False


def step(state: State, move: int) -> tuple[State, int, bool]:
    """Return where a move leads, the reward, and whether the episode is over."""
    x, y = state.x + MOVES[move][0], state.y + MOVES[move][1]
    tile = MAP[y][x]
    if tile == "#" or (tile == "D" and not state.key):
        return state, 0, False
    found = tile == "K" and not state.key
    reward = KEY if found else TREASURE if tile == "T" else 0
    return State(x, y, state.key or found), reward, tile in "^T"
