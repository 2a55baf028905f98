// Runs first, without modules, and says why where the page cannot work.
(function () {
  var status = document.getElementById("status"), reason;
  document.getElementById("ask").addEventListener("submit", function (event) {
    event.preventDefault();
    event.target.dataset.asked = "";
  });
  if (location.protocol === "file:") {
    reason = "A browser loads no scene from a folder: serve it (python -m http.server -d FOLDER), then open http://localhost:8000.";
  } else if (!document.createElement("canvas").getContext("webgl2")) {
    reason = "This browser has no WebGL 2, which draws the scene: update it, or allow hardware acceleration.";
  }
  if (reason) tell(reason);
  // A script of the page, or one that it imports.
  addEventListener("error", function (event) {
    if (event.target.tagName !== "SCRIPT" && !(event.error instanceof SyntaxError)) return;
    tell("The page's scripts can't run: one is missing, the server doesn't send .js files as JavaScript (Python's on Windows may not), or this browser is too old. Copy the whole folder, or try another server or browser.");
  }, true);

  function tell(reason) {
    if ("told" in status.dataset) return;
    status.textContent = reason;
    status.dataset.told = "";
  }
})();
