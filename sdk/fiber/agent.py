"""``python -m fiber.agent``: the process that runs children on another host for a master.

It takes everything from its environment, nothing from its command line (but ``--help``):

``FIBER_AGENT_ADDRESS``      ``host:port`` of the master, or several with commas between: the first
                           that answers counts
``FIBER_AGENT_CREDENTIALS``  the file with the agent's credentials, which the agent removes, or
                           ``fd:N`` for an inherited descriptor that brings them.  The environment
                           of a process is open to those that it starts: no secret is in it
``FIBER_AGENT_KEY``          optional: the folder with the pool's key.  Write the credentials of the
                           pod ``FIBER_AGENT_NAME``, ``FIBER_AGENT_UID`` to that file, and end
``FIBER_AGENT_PARENT``       optional: the pid of a process on this host to end with
``FIBER_AGENT_INHERITS``     optional: a directory of that process, to be removed if it is killed
``FIBER_AGENT_DIRECTORY``    optional: the directory to make for the agent's socket
``FIBER_AGENT_REPORT``       optional: a file for the reason of a failure, beside stderr
``FIBER_AGENT_LOST_GRACE``   optional: serve one master after the other.  Wait for the first for as
                           long as it takes, and after one that was lost for so many seconds,
                           unless that master had said for how many
``FIBER_AGENT_TERMINATION_GRACE``  optional: seconds from SIGTERM to the end by force.  After
                           SIGTERM the agent takes no new work; what runs may end in that time,
                           less what cleaning up takes
``FIBER_AGENT_LINKED``       optional: a file to make once a master has answered
``FIBER_START_TIMEOUT``      seconds to find the master, as for every Fiber process

Exit status 0: the master ended it, or the grace for a lost one is over.  1: it could not join, or
lost the master; stderr says why.  2: it was given arguments.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence


def _run(arguments: Sequence[str]) -> int:
    if set(arguments) & {"-h", "--help"}:
        print(__doc__)
        return 0
    if arguments:
        print(
            f"fiber agent: it takes no arguments, but was given {' '.join(arguments)!r}. It is "
            "configured by its environment: see python -m fiber.agent --help",
            file=sys.stderr,
        )
        return 2
    if "FIBER_AGENT_KEY" in os.environ:
        from fiber._transport import credentials_file

        return credentials_file.write(os.environ)
    # As process 1 of a container it does not get a SIGTERM that it has no handler for: the kernel
    # drops it, and a pod that is deleted just then ends by force, after its grace period.  One that
    # is blocked waits.  So this comes before the imports, which take most of the time.
    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGTERM,))
    from fiber._agent.main import main

    return main()


if __name__ == "__main__":
    sys.exit(_run(sys.argv[1:]))
