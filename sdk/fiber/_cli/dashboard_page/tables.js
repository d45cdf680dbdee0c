// Tables whose cells are changed in place, so that a reader keeps the place in them.

// `columns`: [title, kind] where kind is "number" or "text".  `rows`: lists of text.
export function fill(table, columns, rows, none) {
  if (!table.tHead) {
    const line = table.createTHead().insertRow();
    for (const [title, kind] of columns) {
      const cell = document.createElement("th");
      cell.scope = "col";
      cell.textContent = title;
      cell.className = kind;
      line.append(cell);
    }
    table.append(document.createElement("tbody"));
  }
  const body = table.tBodies[0];
  const lines = rows.length ? rows : [[none]];
  while (body.rows.length > lines.length) body.deleteRow(-1);
  lines.forEach((values, at) => fillRow(body.rows[at] || body.insertRow(), columns, values));
}

function fillRow(row, columns, values) {
  while (row.cells.length > values.length) row.deleteCell(-1);
  values.forEach((value, at) => {
    const cell = row.cells[at] || row.insertCell();
    if (cell.textContent !== value) cell.textContent = value;
    const kind = values.length < columns.length ? "faint" : columns[at][1];
    if (cell.className !== kind) cell.className = kind;
    const span = values.length < columns.length ? columns.length : 1;
    if (cell.colSpan !== span) cell.colSpan = span;
  });
}

// Run `draw` now and then only while the table can be seen.
export function whenOpen(table, draw) {
  const details = table.closest("details");
  if (!details || details.open) draw();
}
