"""What happens to the map: render, compare, optimise, densify, select views, the online loop."""
