"""Generated stereo pairs with exact truth: rooms, objects, piles, terrain, close-ups, outdoor scenes, streets."""
