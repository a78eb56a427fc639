"""What is done with a real robot before it learns: looked at, and measured."""
