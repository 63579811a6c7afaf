"""The models that ship with magpend, and the door through which everyone else sees them."""
