"""Training of the networks that the perception stack uses; the only room that imports torch."""
