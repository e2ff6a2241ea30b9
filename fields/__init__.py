"""The data of the map: the engine's fields and their layout. Independent of files, losses and pipelines."""
