"""Vault whose treasure lies behind a locked door: nothing on the way to the key is rewarded."""

from __future__ import annotations

from typing import NamedTuple

MAP = """\
########################################
#S.......#.......#.........#...........#
#........#..^^...#..^^^....#...^^......#
#..^^....#..^^......^^.....#...^^...K..#
#........#.......#....^^.......^^......#
###.###########.#####.##########.#######
#.........#.........^^.....#...........#
#...^^....#..^^.....^^.....D....^^.....#
#...^^.......^^............#....^^...T.#
########################################
""".splitlines()
MOVES = ((0, -1), (0, 1), (-1, 0), (1, 0))
KEY, TREASURE = 1, 10  # rewards


class State(NamedTuple):
    """Place of the player, and whether it has the key."""

    x: int = 1
    y: int = 1
    key: bool = False


START = State()


def step(state: State, move: int) -> tuple[State, int, bool]:
    """Return the next state, the reward, and whether the episode is over: treasure or spikes."""
    x, y = state.x + MOVES[move][0], state.y + MOVES[move][1]
    tile = MAP[y][x]
    if tile == "#" or (tile == "D" and not state.key):
        return state, 0, False
    found = tile == "K" and not state.key
    return State(x, y, state.key or found), KEY * found or TREASURE * (tile == "T"), tile in "^T"
