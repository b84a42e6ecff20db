"""How a wrist device sits on its forearm, and how late its clocks are, from a motion that marker rig and device see."""
