"""The differentiable renderer: colour, depth and opacity of a view of the map, and their gradients."""
