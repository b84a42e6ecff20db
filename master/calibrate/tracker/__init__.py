"""Registration of a tracking system to the rig and of its device to an object.

The cameras see the object, too.
"""
