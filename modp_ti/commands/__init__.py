"""The commands of `modp-ti`, one file each: arguments in, exit codes out."""
