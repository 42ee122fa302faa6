"""Buildings: static worlds of coloured, labelled parts, furnished from a seed."""
