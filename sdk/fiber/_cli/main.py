"""Entry point of the command ``fiber``, also as ``kubectl fiber``.

Each command is imported when it is used, so that ``fiber --help`` answers at once.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import click

_COMMANDS = {
    "run": "Run a program in a pod, and follow it.",
    "ps": "List the programs of this machine and of the cluster.",
    "logs": "Show the output of a program, or of a worker.",
    "stop": "End a program.",
    "top": "Show what a program does now.",
    "dashboard": "Serve a live page of a program.",
    "stack": "Show where a program and its workers are in their code.",
    "pool": "List, make and scale FiberPools.",
    "doctor": "Find out why programs do not get workers.",
    "image": "Build an image for workers from this environment.",
    "completion": "Print the script that completes words in a shell.",
}
"""Names of the commands, and their help in one line.  Each has a module of its name."""

_WITHOUT = (
    "fiber: the command needs packages that are not installed\n"
    "  why:  {error}\n"
    "  do:   pip install 'fiberpool[cli]', or 'fiberpool[kubernetes]' to use a cluster"
)


def main() -> None:
    """Run the command and end the process with its exit status."""
    try:
        import click
    except ModuleNotFoundError as error:
        print(_WITHOUT.format(error=error), file=sys.stderr)
        sys.exit(1)
    from fiber._cli.failures import INTERRUPTED, CommandError

    try:
        status = _group().main(prog_name=_name(), standalone_mode=False)
    except CommandError as error:
        print(error, file=sys.stderr)
        sys.exit(error.status)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        print("fiber: interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except BrokenPipeError:  # the reader of a pipe, such as head, has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # the interpreter flushes it at the end
        sys.exit(1)
    except OSError as error:  # for example, the working directory is gone
        print(f"fiber: the command failed\n  why:  {error}", file=sys.stderr)
        sys.exit(1)
    sys.exit(status if isinstance(status, int) else 0)


def _name() -> str:
    return "kubectl fiber" if sys.argv[0].endswith("kubectl-fiber") else "fiber"


def _group() -> click.Group:
    import click

    class Commands(click.Group):
        """Group of commands that are imported when they are used."""

        def list_commands(self, ctx: click.Context) -> list[str]:
            return list(_COMMANDS)

        def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
            if name not in _COMMANDS:
                return None
            module = importlib.import_module(f"fiber._cli.{name}")
            command: click.Command = module.command
            return command

        def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
            with formatter.section("Commands"):
                formatter.write_dl(list(_COMMANDS.items()))

    return Commands(
        "fiber",
        help="Run Python programs whose processes are pods, and look after them.",
        context_settings={"help_option_names": ["-h", "--help"]},
        params=[_version()],
        no_args_is_help=True,
    )


def _version() -> click.Option:
    import click

    import fiber

    def show(ctx: click.Context, param: click.Parameter, value: bool) -> None:
        if value and not ctx.resilient_parsing:
            click.echo(f"fiber {fiber.__version__}")
            ctx.exit()

    return click.Option(
        ["--version"],
        is_flag=True,
        is_eager=True,
        expose_value=False,
        callback=show,
        help="Show the version and exit.",
    )


if __name__ == "__main__":
    main()
