"""The viewer: a web page that shows a map while it grows, or a finished one."""
