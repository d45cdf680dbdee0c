"""The one process-wide state of Fiber: started by the first process or pool, never by an import."""
