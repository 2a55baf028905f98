"""Things: single windows, portals and towers in place of heat maps, to count, name and visit."""
