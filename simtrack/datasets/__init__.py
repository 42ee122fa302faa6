"""Labelled data sets: recipes, generation, label writers, validation and a look at what was made."""
