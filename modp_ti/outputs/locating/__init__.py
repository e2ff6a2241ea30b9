"""Localisation of new pictures in a finished map."""
