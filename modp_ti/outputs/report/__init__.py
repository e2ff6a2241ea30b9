"""`report.html`: a self-contained page about a run, for reading offline and printing."""
