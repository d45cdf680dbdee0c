"""CleanRL: its PPO, unmodified, whose environments `fiber.vector` steps."""

from __future__ import annotations

from conformance import cleanrl_ppo
from published.records import Package, Program
from published.runs import Run, RunFailed, Value

STEPS = "2048"


def run(run: Run) -> dict[str, Value]:
    """Learn CartPole; compare all logged losses and returns.

    Without Fiber, the environments are those of CleanRL, in the learner's process.
    """
    program = run.clone / "cleanrl" / "ppo.py"
    vector_env = "fiber" if run.on_fiber else "gymnasium"
    logged = cleanrl_ppo.logged(vector_env, program, ["--total-timesteps", STEPS])
    if not logged:
        raise RunFailed("CleanRL's PPO logged nothing: its output is above")
    return {"logged": logged}


PROGRAMS = [
    Program(
        name="CleanRL",
        upstream="https://github.com/vwxyzjn/cleanrl",
        clone="cleanrl",
        way="`fiber.vector.VectorEnv`",
        ran=f"its `ppo.py` on CartPole, {STEPS} steps",
        run=run,
        files=("cleanrl/ppo.py",),
        packages=(
            Package("gymnasium", "gymnasium>=1.0"),
            Package("tensorboard", "tensorboard>=2.9"),  # workers import its program, too
            Package("torch", "torch>=2.3"),
            Package("tyro", "tyro>=0.8"),
        ),
        stood_in=("tensorboard",),
    )
]
