"""One module a kind of table; `catalogue` says which table number is of which kind."""
