"""Preparation before the tests, outside their time limits: it takes minutes the first time.

Nothing here is an error of its own. What could not be made ready is said, and said again by the
tests that need it.
"""

from __future__ import annotations

import os
import shutil

from cluster import ability, build, images, packages
from cluster.ability import Choice
from cluster.pause import pause_archive
from cluster.shell import ClusterError, say


def prepare() -> None:
    """Build and install what the tests of the chart and the end-to-end tests will ask for."""
    try:
        if shutil.which("helm") is None:
            build.build(["helm"])
        if ability.choose(os.environ)[0] is Choice.OWN:
            _prepare_cluster()
    except ClusterError as error:
        say(f"the tests that need a cluster are not prepared: {error}")


def _prepare_cluster() -> None:
    packages.need(packages.TO_RUN, "run the test cluster")
    build.build(["kubernetes", "helm"])
    pause_archive()
    images.build_images()
