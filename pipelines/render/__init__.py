"""The renderer: a view of the map as colour, depth and opacity, and its gradients."""
