"""Where the object is: by its mesh in a map, landmarks, a board, a picture or a guess."""
