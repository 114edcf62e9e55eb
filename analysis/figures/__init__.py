"""One module a kind of figure; `catalogue` says which figure number is of which kind."""
