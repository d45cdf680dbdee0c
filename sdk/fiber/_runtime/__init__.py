"""The one process-wide state of Fiber: started by the first process or pool, never by an import."""

import sys

if not hasattr(sys.modules["fiber"], "_OTHER_FILES"):
    from fiber import _installation

    raise _installation.overwritten()
