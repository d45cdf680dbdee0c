"""CleanRL's PPO, unmodified, with ``fiber.vector.VectorEnv`` in the place of ``SyncVectorEnv``:

    python tests/conformance/cleanrl_ppo.py CHECKOUT [ppo.py's options]

where CHECKOUT is CleanRL's repository.  It learns the same CartPole twice, once with each, and says
whether all that it logs (losses, entropy, explained variance, returns) is the same to the last bit.
It needs the packages of CleanRL: torch and tyro.
"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

OPTIONS = ("--total-timesteps", "8192", "--no-cuda", "--num-envs", "4")
WITHIN = "--within"


class PrintedScalars:
    """Stand-in for ``SummaryWriter`` of TensorBoard; it ignores values of the clock."""

    def __init__(self, _folder: str) -> None:
        pass

    def add_scalar(self, name: str, value: Any, step: int) -> None:
        """Print the value, exactly."""
        if not name.endswith("SPS"):
            print(f"{step} {name} {float(value).hex()}")

    def add_text(self, _name: str, _text: str) -> None:
        """Ignore the text."""

    def close(self) -> None:
        """Close the writer, which has no open file."""


def within(vector_env: str, program: str) -> None:
    """Run CleanRL's program in this process, with this vector environment."""
    import gymnasium

    sys.modules["torch.utils.tensorboard"] = SimpleNamespace(  # type: ignore[assignment]
        SummaryWriter=PrintedScalars
    )
    if vector_env == "fiber":
        from fiber.vector import VectorEnv

        gymnasium.vector.SyncVectorEnv = VectorEnv  # type: ignore[assignment, misc]
    runpy.run_path(program, run_name="__main__")


def logged(vector_env: str, program: Path, options: list[str]) -> list[str]:
    """Run CleanRL's program in a process and return its logged values."""
    done = subprocess.run(
        [sys.executable, __file__, WITHIN, vector_env, str(program), *OPTIONS, *options],
        stdout=subprocess.PIPE,
        check=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    return [line for line in done.stdout.splitlines() if not line.startswith("SPS")]


def main(checkout: str, *options: str) -> int:
    """Compare them; 0 if they are the same."""
    program = Path(checkout).resolve() / "cleanrl/ppo.py"
    expected, found = (logged(each, program, list(options)) for each in ("gymnasium", "fiber"))
    print(f"{len(expected)} values logged, the last: {expected[-1]}")
    same = bool(expected) and expected == found
    print("the same" if same else "not the same")
    return 0 if same else 1


if __name__ == "__main__":
    if sys.argv[1] == WITHIN:
        _, _, env, path, *sys.argv[1:] = sys.argv
        within(env, path)
    else:
        sys.exit(main(*sys.argv[1:]))
