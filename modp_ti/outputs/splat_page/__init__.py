"""The map as one web page that needs no network: the map, SuperSplat's viewer and a flight along the trajectory."""
