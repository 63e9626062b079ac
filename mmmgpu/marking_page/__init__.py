"""The page of `mmmgpu mark`: what the browser gets, served by `mmmgpu.marking_server`.

`mark.html` is the page, `mark.js` puts it together from `marks.js` (the points, with undo),
`view.js` (a picture with points on it) and `keeper.js` (the server's side).
"""
