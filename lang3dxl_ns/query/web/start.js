// Runs first, without modules, and says why where the page cannot work.
(function () {
  var status = document.getElementById("status");
  if (location.protocol === "file:") {
    status.textContent = "A browser loads no scene from a folder: serve it (python -m http.server -d FOLDER), then open http://localhost:8000.";
  } else if (!document.createElement("canvas").getContext("webgl2")) {
    status.textContent = "This browser has no WebGL 2, which draws the scene: update it, or allow hardware acceleration.";
  }
})();
