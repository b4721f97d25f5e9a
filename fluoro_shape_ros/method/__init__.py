"""From a pair of images to a backbone: propose, fit, judge."""
