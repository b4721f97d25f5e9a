"""What is seen without RViz: images, backbone and figures over time in Rerun, live from topics or from a bag."""
