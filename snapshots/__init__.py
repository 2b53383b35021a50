"""The state of living objects as plain data, and back into objects that were built anew.

`record` walks through objects and writes down what they hold: arrays as arrays, everything else as
JSON. `restore` pours that into objects of the same build, in place, so that whatever points at them
goes on pointing at them. Nothing is pickled, no class is imported and no function is called because
a snapshot asks for it: code comes from the objects that are there, and a snapshot fills them.
"""
