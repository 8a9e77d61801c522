"""What a surface is: fields of one shape or several, closed forms, and DeepSDF's network."""
