"""The browser viewer: `roboarm view` and `roboarm demo` (extra `viewer`)."""
