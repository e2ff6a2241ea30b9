"""The commands of `modp-ti`, one file per command: arguments, output and exit codes."""
