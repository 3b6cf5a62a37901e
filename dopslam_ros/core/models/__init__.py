"""How the vehicle moves and what it hears: motion, channel, detection."""
