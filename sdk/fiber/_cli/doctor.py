"""``fiber doctor``: check everything between this machine and a worker that runs a task."""

from __future__ import annotations

import json
from collections.abc import Iterable

import click

from fiber._cli.doctor_attempt import attempt
from fiber._cli.doctor_checks import examine, hidden, obstacle
from fiber._cli.doctor_facts import Facts, Gatherer, Place, Wishes
from fiber._cli.doctor_trial_verdicts import NAME, Program, judge
from fiber._cli.doctor_verdicts import State, Verdict, lines_of, unknown
from fiber._cli.failures import FAILED
from fiber._cli.image_packages import IN_EACH_IMAGE, canonical, installed
from fiber._cli.session import cluster_options, output_option
from fiber.config import Config


@click.command("doctor")
@click.option("--image", metavar="IMAGE", help="Image of workers.  Default: as for a program.")
@click.option("--no-trial", is_flag=True, help="Only look; make no FiberPool.")
@cluster_options
@output_option
def command(
    namespace: str | None, context: str | None, image: str | None, output: str, no_trial: bool
) -> int:
    """Find out why programs do not get workers.

    Each line is a check: a tick, a cross with the reason and what to do, or "-" where it cannot
    look.  At the end a worker runs one task and is removed.  The exit status is 0 only if that
    worked; with --no-trial, if no check found a fault.

    \b
    Examples:
      fiber doctor
      fiber doctor --namespace team-a --no-trial --output json
    """
    gatherer = Gatherer(Wishes(namespace, context, image))
    try:
        facts = gatherer.gather()
        verdicts = examine(facts)
        _show(verdicts, output)
        if not no_trial:
            trial = _trial(gatherer, facts, obstacle(verdicts))
            _show(trial, output)
            verdicts += trial
    finally:
        gatherer.close()
    if output == "json":
        click.echo(json.dumps([verdict.document() for verdict in verdicts], indent=2))
    return status_of(verdicts)


def status_of(verdicts: Iterable[Verdict]) -> int:
    """Return the exit status: that of the trial or, without one, of all checks."""
    found = list(verdicts)
    trial = [verdict for verdict in found if verdict.check == NAME]
    if trial:
        return 0 if all(verdict.state in (State.OK, State.NOTE) for verdict in trial) else FAILED
    return FAILED if any(verdict.state is State.FAULT for verdict in found) else 0


def _trial(gatherer: Gatherer, facts: Facts, cause: str | None) -> list[Verdict]:
    if cause is not None:
        return [hidden(NAME, cause)]
    if gatherer.api is None or not isinstance(facts.configuration, Config):
        return [unknown("not possible")._replace(check=NAME)]
    assert isinstance(facts.place, Place)
    assert isinstance(facts.image, tuple)
    click.echo("making a FiberPool with one worker...", err=True)
    place, settings = facts.place.namespace, facts.configuration
    program = Program(
        place,
        facts.image[0],
        wants_relay=settings.relay == "always",
        packages=frozenset(canonical(each.name) for each in installed()) - IN_EACH_IMAGE,
    )
    return judge(attempt(gatherer.api, place, settings, _tell), program)


def _tell(line: str) -> None:
    click.echo(f"  {line}", err=True)


def _show(verdicts: Iterable[Verdict], output: str) -> None:
    if output == "table":
        for line in lines_of(verdicts):
            click.echo(line)
