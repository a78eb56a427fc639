"""One folder per service; `cli` starts them. Services never import each other."""
