"""Dense depth of a generated view: its picture and what the map knows of it go in, depth with a
calibrated confidence comes out.
"""
