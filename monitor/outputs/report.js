"use strict";
// Draws the drift of every axis over time from the data that stands in the page.
(() => {
  const pairs = JSON.parse(document.getElementById("series").textContent);
  const tints = { healthy: "#1f8a54", suspect: "#e09a1a", drifted: "#c62828", unobservable: "#69727d",
    stale: "#4a5b80", fault: "#7b2d8b", starting: "#a9b6c3" };

  // The states lie behind the curve, faint; the limits stand as red lines, the onset as a black one in its interval.
  function background(u, pair, limit) {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    for (const span of pair.states) {
      const from = u.valToPos(span.from, "x", true);
      const to = u.valToPos(span.to, "x", true);
      ctx.fillStyle = tints[span.state] + "1c";
      ctx.fillRect(from, bbox.top, to - from, bbox.height);
    }
    ctx.strokeStyle = "#c62828";
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
    for (const level of [-limit, limit]) {
      const y = u.valToPos(level, "y", true);
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
    }
    if (pair.onset !== null) {
      const from = u.valToPos(pair.onset.from, "x", true);
      ctx.fillStyle = "#1d253026";
      ctx.fillRect(from, bbox.top, Math.max(u.valToPos(pair.onset.to, "x", true) - from, 1), bbox.height);
      const x = u.valToPos(pair.onset.at, "x", true);
      ctx.strokeStyle = "#1d2530";
      ctx.setLineDash([2 * devicePixelRatio, 3 * devicePixelRatio]);
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
    }
    ctx.restore();
  }

  function extent(axis) {
    let most = 1.25 * axis.limit;
    axis.value.forEach((value, i) => {
      if (value !== null) most = Math.max(most, Math.abs(value) + Math.min(2 * axis.sigma[i], axis.limit));
    });
    return [-1.05 * most, 1.05 * most];
  }

  for (const pair of pairs) {
    const sync = uPlot.sync(pair.name);
    const drawn = [];
    for (const axis of pair.axes) {
      const place = document.getElementById(axis.id);
      const low = axis.value.map((value, i) => (value === null ? null : value - 2 * axis.sigma[i]));
      const high = axis.value.map((value, i) => (value === null ? null : value + 2 * axis.sigma[i]));
      const told = (u, value, series, i) => (value === null || value === undefined || i === null ? "–"
        : value.toFixed(3) + " ± " + axis.sigma[i].toFixed(3) + " " + axis.unit);
      const hidden = { width: 0, points: { show: false } };
      const seen = axis.value.some((value) => value !== null);
      const plot = new uPlot({
        title: axis.name + " [" + axis.unit + "], limit ±" + axis.limit + (seen ? "" : ": not observable"),
        width: place.clientWidth, height: 190,
        cursor: { sync: { key: sync.key }, drag: { x: true, y: false } },
        scales: { x: { time: false }, y: { range: extent(axis) } },
        axes: [{ size: 34, label: "s from the start", labelSize: 18, labelFont: "11px sans-serif", font: "11px sans-serif" },
          { size: 54, font: "11px sans-serif" }],
        series: [{ label: "s", value: (u, value) => (value === null ? "–" : value.toFixed(1)) },
          { ...hidden, label: "−2 sigma" }, { ...hidden, label: "+2 sigma" },
          { label: axis.name, stroke: "#1668a8", width: 1.6, points: { show: false }, value: told }],
        bands: [{ series: [2, 1], fill: "#1668a833" }],
        hooks: { drawClear: [(u) => background(u, pair, axis.limit)] },
      }, [pair.seconds, low, high, axis.value], place);
      sync.sub(plot);
      drawn.push([plot, place]);
    }
    addEventListener("resize", () => drawn.forEach(([plot, place]) => plot.setSize({ width: place.clientWidth, height: 190 })));
  }
})();
