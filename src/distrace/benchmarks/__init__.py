"""What `distrace bench` measures: strategies of tracing, random views, derivatives; and its pages."""
