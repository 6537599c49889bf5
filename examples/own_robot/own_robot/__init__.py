"""A task, a method, an exploration and a search of one's own: one file, one of them. Entry points name them."""
