"""Features, poses and points of several views: what trackers without points of their own are completed with."""
