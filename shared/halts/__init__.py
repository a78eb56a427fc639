"""Stop and pause as states: who keeps them, who tells of them, who orders them."""
