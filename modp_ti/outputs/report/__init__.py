"""`report.html`: what a run did, as one page that can be read and printed without network."""
