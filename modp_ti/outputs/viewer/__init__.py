"""The viewer: a web page that shows a growing or a finished map."""
