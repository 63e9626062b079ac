"""The page of `mmmgpu study serve`: what a participant's browser gets from `mmmgpu.study_server`.

`study.html` is the page, `study.js` plays the pairs and sends the answers, `study.css` its looks.
"""
