"""``python -m fiber.agent``: the process that runs children on another host for a master.

It is configured by its environment.  The command line takes ``--help`` only:

``FIBER_AGENT_ADDRESS``      ``host:port`` of the master, or several with commas between: the agent
                           uses the first that answers
``FIBER_AGENT_CREDENTIALS``  the file with the agent's credentials, which the agent removes, or
                           ``fd:N`` for an inherited descriptor to read them from.  Children can
                           read the environment of their parent, so it contains no secret
``FIBER_AGENT_KEY``          optional: the folder with the pool's key.  Write the credentials of the
                           pod ``FIBER_AGENT_NAME``, ``FIBER_AGENT_UID`` to that file, and end
``FIBER_AGENT_PARENT``       optional: the pid of a process on this host.  End when it ends
``FIBER_AGENT_INHERITS``     optional: a directory of that process, to be removed if it is killed
``FIBER_AGENT_DIRECTORY``    optional: the directory to make for the agent's socket
``FIBER_AGENT_REPORT``       optional: a file for the reason of a failure, beside stderr
``FIBER_AGENT_LOST_GRACE``   optional: serve one master after the other.  Wait for the first one
                           without limit.  After a lost master, wait so many seconds for the
                           next one, or as long as the lost master had set
``FIBER_AGENT_TERMINATION_GRACE``  optional: seconds from SIGTERM to the end by force.  After
                           SIGTERM the agent takes no new work.  Running tasks may end in that
                           time, less the time for cleaning up
``FIBER_RELAY_AGENTS_PORT``  optional: relay between agents and a master, and run no agent.  The
                           port for agents
``FIBER_RELAY_MASTER_PORT``  the port on the loopback for the master of a relay
``FIBER_AGENT_LINKED``       optional: a file to make once a master has answered
``FIBER_START_TIMEOUT``      seconds to find the master, as for every Fiber process

Exit status 0: the master ended the agent, or the wait for a new master is over.  1: the agent could
not join, or lost the master; stderr says why.  2: unexpected arguments.
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
            f"fiber agent: unexpected arguments {' '.join(arguments)!r}. An agent is configured "
            "by its environment: see python -m fiber.agent --help",
            file=sys.stderr,
        )
        return 2
    if "FIBER_AGENT_KEY" in os.environ:
        from fiber._transport import credentials_file

        return credentials_file.write(os.environ)
    if "FIBER_RELAY_AGENTS_PORT" in os.environ:
        from fiber._transport import relay

        return relay.run(os.environ)
    # The agent is process 1 of a container.  The kernel drops a SIGTERM for which process 1 has no
    # handler, and then a deleted pod ends by force after its grace period.  A blocked signal waits.
    # So this comes before the imports, which take most of the time.
    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGTERM,))
    from fiber._agent.main import main

    return main()


if __name__ == "__main__":
    sys.exit(_run(sys.argv[1:]))
