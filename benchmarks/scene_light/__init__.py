"""What scenes do to the light of a pixel: is it found at run time, and removed?"""
