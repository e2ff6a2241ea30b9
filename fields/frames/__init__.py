"""Input of the mapper: tracked frames with their points, and corrections of poses."""
