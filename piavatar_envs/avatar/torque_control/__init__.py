"""Torque control: an articulated body coupled to flesh; begin with :mod:`.controller`, then :mod:`.stages`."""
