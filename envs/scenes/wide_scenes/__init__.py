"""Wide scenes: random places where arms work, from kitchens to building sites.

`distribution` draws scenes; each family of places is a function in `homes`, `industry` or
`outdoors`.
"""
