"""Many simple robots without a physics engine: all of them advance together, as arrays.

For fleets whose robots never touch: nothing pushes anything, a contact is only counted.
"""
