"""A page and an HTTP interface that reconstruct captures, for people and programs."""
