"""How long a test waits for a process, a thread or a connection before it is taken to hang."""

# Minutes [s]: whether a test passes must not depend on the speed of the machine, or on what runs beside it.
PATIENCE = 1200.0
