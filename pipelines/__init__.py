"""Operations on the map: rendering, losses, optimisation, densification, view selection, the online loop."""
