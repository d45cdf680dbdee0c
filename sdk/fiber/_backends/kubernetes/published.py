"""Images and chart that a release publishes: where they are, and what to do without them.

``REGISTRY`` is the one place that says where they are.  It is empty in a checkout: no registry has
images of a development build.  ``python -m release build`` fills it in the packages of a release,
and with it ``image.repository`` in the chart's values.
"""

from __future__ import annotations

import re
import sys

import fiber

REGISTRY = ""
"""Registry and path of the images and of the chart; empty in a development build."""

PYTHONS = ("3.11", "3.12", "3.13")
"""Versions of Python for which a release has images of workers."""

WORKER, OPERATOR = "fiber-worker", "fiber-operator"
"""Names of the images.  The chart has the operator's name."""

_HERE = f"{sys.version_info[0]}.{sys.version_info[1]}"


def worker_image(python: str = _HERE) -> str | None:
    """Return this release's image of workers with this Python; None if none is published."""
    if not REGISTRY or python not in PYTHONS:
        return None
    return f"{REGISTRY}/{WORKER}:{fiber.__version__}-py{python}"


def reason_for_no_image(python: str = _HERE) -> str:
    """Return why ``worker_image`` is None."""
    if not REGISTRY:
        return f"Fiber {fiber.__version__} is a development build, and no registry has its images"
    return f"this is Python {python}, and images are published for {', '.join(PYTHONS)}"


SET_IMAGE = (
    "set image (fiber.init(image=), FIBER_IMAGE, or image in [tool.fiber] of pyproject.toml) to an "
    "image that the nodes can pull. `fiber image build --tag REGISTRY/NAME --push` makes one; in a "
    'shell with `eval "$(make -s cluster)"` it is set'
)
"""Advice for programs without an image."""


def install_command() -> str:
    """Return the command that installs the operator."""
    chart = f"charts/{OPERATOR} --set image.repository=REGISTRY/{OPERATOR}"
    if REGISTRY:
        chart = f"oci://{REGISTRY}/charts/{OPERATOR} --version {chart_version(fiber.__version__)}"
    return f"helm install {OPERATOR} {chart} --namespace fiber-system --create-namespace"


def chart_version(version: str) -> str:
    """Return the chart's version, which has a hyphen before the name of a pre-release."""
    return re.sub(r"\.?(rc|dev)(\d+)$", r"-\1\2", version)
