"""The command ``simtrack``: one module a verb; each imports what it needs when it runs."""
