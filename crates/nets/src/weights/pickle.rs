//! Python's pickles as far as PyTorch writes them, read as a graph: what a file asks to be called is noted, and never called.
//!
//! All that is read lies in one list, and everything refers to it by its place there. So nothing is copied when it is used again,
//! nothing is ever as deep as the stack, and the steps that a pickle may take bound its memory.

use std::collections::BTreeMap;

type Result<T> = std::result::Result<T, String>;

/// Steps that a pickle may take. A tensor takes about forty; 6,000 are enough for any network.
const MOST_STEPS: usize = 1 << 18;

/// The place of a value in its [`Pickle`].
pub(super) type Id = u32;

/// A value.
#[derive(Debug)]
pub(super) enum Node<'p> {
    Int(i64),
    Text(&'p str),
    /// A class or a function, by its name without the module.
    Class(&'p str),
    Tuple(Vec<Id>),
    List(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    /// What lies outside of the pickle, such as a storage, under this name.
    Persistent(Id),
    /// The result of a call: what is called, and its arguments.
    Call(Id, Id),
    /// Nothing that weights are made of.
    Other,
}

/// What a pickle holds.
#[derive(Debug)]
pub(super) struct Pickle<'p> {
    nodes: Vec<Node<'p>>,
    root: Id,
}

impl<'p> Pickle<'p> {
    /// Reads one pickle from the beginning of `bytes`, which afterwards begin behind it.
    pub(super) fn read(bytes: &mut &'p [u8]) -> Result<Self> {
        let mut machine = Machine::default();
        for _ in 0..MOST_STEPS {
            if let Some(root) = machine.step(bytes)? {
                return Ok(Self { nodes: machine.nodes, root });
            }
        }
        Err(format!("its pickle takes more than {MOST_STEPS} steps, which no network needs"))
    }

    pub(super) fn root(&self) -> &Node<'p> {
        self.node(self.root)
    }

    pub(super) fn node(&self, id: Id) -> &Node<'p> {
        &self.nodes[id as usize]
    }

    pub(super) fn nodes(&self) -> impl Iterator<Item = &Node<'p>> {
        self.nodes.iter()
    }

    pub(super) fn text(&self, id: Id) -> Option<&'p str> {
        if let Node::Text(text) = self.node(id) { Some(text) } else { None }
    }

    pub(super) fn class(&self, id: Id) -> Option<&'p str> {
        if let Node::Class(name) = self.node(id) { Some(name) } else { None }
    }

    pub(super) fn tuple(&self, id: Id) -> Option<&[Id]> {
        if let Node::Tuple(items) = self.node(id) { Some(items) } else { None }
    }

    pub(super) fn size(&self, id: Id) -> Option<usize> {
        if let Node::Int(n) = self.node(id) { usize::try_from(*n).ok() } else { None }
    }
}

/// Python's pickle machine.
#[derive(Default)]
struct Machine<'p> {
    nodes: Vec<Node<'p>>,
    stack: Vec<Id>,
    /// Heights of the stack that are marked.
    marks: Vec<usize>,
    memo: BTreeMap<u32, Id>,
}

const CUT_SHORT: &str = "its pickle is cut short";

impl<'p> Machine<'p> {
    /// Does one operation; the root, if it was the last one.
    fn step(&mut self, bytes: &mut &'p [u8]) -> Result<Option<Id>> {
        match number(bytes, 1)? as u8 {
            // Version of the protocol, size of a frame.
            0x80 => drop(take(bytes, 1)?),
            0x95 => drop(take(bytes, 8)?),
            b'.' => return self.pop().map(Some),
            b'N' | 0x88 | 0x89 => self.push(Node::Other),
            b'G' => {
                take(bytes, 8)?;
                self.push(Node::Other);
            }
            b'K' => self.push_number(bytes, 1)?,
            b'M' => self.push_number(bytes, 2)?,
            b'J' => {
                let n = number(bytes, 4)? as u32;
                self.push(Node::Int(i64::from(n.cast_signed())));
            }
            0x8a => self.long(bytes)?,
            b'U' | 0x8c => self.text(bytes, 1)?,
            b'T' | b'X' => self.text(bytes, 4)?,
            0x8d => self.text(bytes, 8)?,
            b'c' => {
                line(bytes)?;
                let name = line(bytes)?;
                self.push(Node::Class(name));
            }
            0x93 => self.class()?,
            b'q' => self.remember(number(bytes, 1)? as u32)?,
            b'r' => self.remember(number(bytes, 4)? as u32)?,
            0x94 => self.remember(self.memo.len() as u32)?,
            b'h' => self.recall(number(bytes, 1)? as u32)?,
            b'j' => self.recall(number(bytes, 4)? as u32)?,
            b'(' => self.marks.push(self.stack.len()),
            b'0' => drop(self.pop()?),
            b'1' => drop(self.since_mark()?),
            b'2' => self.stack.push(self.top()?),
            b')' => self.push(Node::Tuple(Vec::new())),
            b']' => self.push(Node::List(Vec::new())),
            b'}' => self.push(Node::Dict(Vec::new())),
            count @ 0x85..=0x87 => {
                let items = self.last(usize::from(count - 0x84))?;
                self.push(Node::Tuple(items));
            }
            b't' => {
                let items = self.since_mark()?;
                self.push(Node::Tuple(items));
            }
            b'a' => {
                let items = self.last(1)?;
                self.append(&items)?;
            }
            b'e' => {
                let items = self.since_mark()?;
                self.append(&items)?;
            }
            b's' => {
                let items = self.last(2)?;
                self.insert(&items)?;
            }
            b'u' => {
                let items = self.since_mark()?;
                self.insert(&items)?;
            }
            b'Q' => {
                let name = self.pop()?;
                self.push(Node::Persistent(name));
            }
            b'R' | 0x81 => self.call()?,
            // An object takes up its state, which for the dictionaries of PyTorch is no part of their contents.
            b'b' => drop(self.pop()?),
            other => return Err(format!("its pickle has the operation {other:#04x}, which PyTorch does not write")),
        }
        Ok(None)
    }

    fn push(&mut self, node: Node<'p>) {
        // The steps are counted, and each makes at most one.
        self.stack.push(self.nodes.len() as Id);
        self.nodes.push(node);
    }

    fn push_number(&mut self, bytes: &mut &'p [u8], size: usize) -> Result<()> {
        let n = number(bytes, size)?;
        self.push(Node::Int(n as i64));
        Ok(())
    }

    /// A number of any length, of which those up to 8 bytes matter.
    fn long(&mut self, bytes: &mut &'p [u8]) -> Result<()> {
        let length = number(bytes, 1)? as usize;
        let digits = take(bytes, length)?;
        let sign = if digits.last().is_some_and(|b| b & 0x80 != 0) { 0xff } else { 0 };
        let mut whole = [sign; 8];
        let node = match whole.get_mut(..length) {
            Some(low) => {
                low.copy_from_slice(digits);
                Node::Int(i64::from_le_bytes(whole))
            }
            None => Node::Other,
        };
        self.push(node);
        Ok(())
    }

    fn text(&mut self, bytes: &mut &'p [u8], size: usize) -> Result<()> {
        let length = usize::try_from(number(bytes, size)?).map_err(|_| CUT_SHORT)?;
        let text = std::str::from_utf8(take(bytes, length)?).map_err(|_| "its pickle has a name that is no text")?;
        self.push(Node::Text(text));
        Ok(())
    }

    /// A class whose module and name are on the stack.
    fn class(&mut self) -> Result<()> {
        let name = self.last(2)?[1];
        let Node::Text(name) = self.nodes[name as usize] else { return Err("its pickle names no class".into()) };
        self.push(Node::Class(name));
        Ok(())
    }

    fn top(&self) -> Result<Id> {
        let empty = self.stack.len() <= self.marks.last().copied().unwrap_or(0);
        self.stack.last().copied().filter(|_| !empty).ok_or_else(|| "its pickle takes what it did not put".into())
    }

    fn pop(&mut self) -> Result<Id> {
        let top = self.top()?;
        self.stack.pop();
        Ok(top)
    }

    /// Pops some values, which keep their order.
    fn last(&mut self, count: usize) -> Result<Vec<Id>> {
        let mut items = (0..count).map(|_| self.pop()).collect::<Result<Vec<_>>>()?;
        items.reverse();
        Ok(items)
    }

    fn since_mark(&mut self) -> Result<Vec<Id>> {
        let height = self.marks.pop().ok_or("its pickle ends a list that it did not begin")?;
        // As long as what is in it, where `split_off` may be as long as the stack ever was.
        Ok(self.stack.drain(height..).collect())
    }

    fn remember(&mut self, key: u32) -> Result<()> {
        let top = self.top()?;
        self.memo.insert(key, top);
        Ok(())
    }

    fn recall(&mut self, key: u32) -> Result<()> {
        let id = *self.memo.get(&key).ok_or("its pickle recalls what it did not put")?;
        self.stack.push(id);
        Ok(())
    }

    fn append(&mut self, items: &[Id]) -> Result<()> {
        let top = self.top()?;
        match &mut self.nodes[top as usize] {
            Node::List(list) => list.extend(items),
            // A list of another kind, of which weights are not made.
            Node::Call(..) => {}
            _ => return Err("its pickle appends to what is no list".into()),
        }
        Ok(())
    }

    fn insert(&mut self, items: &[Id]) -> Result<()> {
        let (pairs, []) = items.as_chunks::<2>() else { return Err("its pickle has a key without a value".into()) };
        let top = self.top()?;
        match &mut self.nodes[top as usize] {
            Node::Dict(dict) => dict.extend(pairs.iter().map(|&[key, value]| (key, value))),
            Node::Call(..) => {}
            _ => return Err("its pickle sets a key of what is no dictionary".into()),
        }
        Ok(())
    }

    fn call(&mut self) -> Result<()> {
        let (arguments, callee) = (self.pop()?, self.pop()?);
        let dictionary = matches!(self.nodes[callee as usize], Node::Class("OrderedDict" | "defaultdict"));
        self.push(if dictionary { Node::Dict(Vec::new()) } else { Node::Call(callee, arguments) });
        Ok(())
    }
}

fn take<'p>(bytes: &mut &'p [u8], count: usize) -> Result<&'p [u8]> {
    let (taken, rest) = bytes.split_at_checked(count).ok_or(CUT_SHORT)?;
    *bytes = rest;
    Ok(taken)
}

/// A number without sign, of up to 8 bytes, the low ones first.
fn number(bytes: &mut &[u8], size: usize) -> Result<u64> {
    Ok(take(bytes, size)?.iter().rev().fold(0, |n, &byte| n << 8 | u64::from(byte)))
}

fn line<'p>(bytes: &mut &'p [u8]) -> Result<&'p str> {
    let length = bytes.iter().position(|&b| b == b'\n').ok_or(CUT_SHORT)?;
    let line = take(bytes, length)?;
    take(bytes, 1)?;
    std::str::from_utf8(line).map_err(|_| "its pickle has a name that is no text".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(bytes: &[u8]) -> Result<Pickle<'_>> {
        Pickle::read(&mut &*bytes)
    }

    #[test]
    fn values_are_what_python_put() {
        // `pickle.dumps([-2, 300, 70000, "a", ("b", 2**40), {"k": 1}], 2)`
        let bytes =
            b"\x80\x02]q\x00(J\xfe\xff\xff\xffM\x2c\x01J\x70\x11\x01\x00X\x01\x00\x00\x00aq\x01X\x01\x00\x00\x00bq\x02\
                      \x8a\x06\x00\x00\x00\x00\x00\x01\x86q\x03}q\x04X\x01\x00\x00\x00kq\x05K\x01se.";
        let pickle = read(bytes).unwrap();
        let Node::List(items) = pickle.root() else { panic!("{pickle:?}") };
        let ints: Vec<i64> =
            items.iter().filter_map(|&id| if let Node::Int(n) = pickle.node(id) { Some(*n) } else { None }).collect();
        assert_eq!(ints, [-2, 300, 70_000]);
        assert_eq!(pickle.text(items[3]), Some("a"));
        let tuple = pickle.tuple(items[4]).unwrap();
        assert_eq!((pickle.text(tuple[0]), pickle.size(tuple[1])), (Some("b"), Some(1 << 40)));
        let Node::Dict(entries) = pickle.node(items[5]) else { panic!("{pickle:?}") };
        assert_eq!((pickle.text(entries[0].0), pickle.size(entries[0].1)), (Some("k"), Some(1)));
    }

    #[test]
    fn what_was_put_aside_is_one_and_the_same() {
        // The list is recalled before it is filled.
        let pickle = read(b"]q\x00h\x00K\x07a\x86.").unwrap();
        let Node::Tuple(both) = pickle.root() else { panic!("{pickle:?}") };
        assert_eq!(both[0], both[1]);
        assert!(matches!(pickle.node(both[0]), Node::List(items) if items.len() == 1));
    }

    #[test]
    fn neither_depth_nor_doubling_costs_anything() {
        let deep = [b"N".to_vec(), vec![0x85; 200_000], b".".to_vec()].concat();
        assert!(matches!(read(&deep).unwrap().root(), Node::Tuple(items) if items.len() == 1));
        let deeper = [b"N".to_vec(), vec![0x85; MOST_STEPS], b".".to_vec()].concat();
        assert!(read(&deeper).unwrap_err().contains("steps"));
        let doubled = [b"N".to_vec(), b"q\x00h\x00\x86".repeat(60), b".".to_vec()].concat();
        assert_eq!(read(&doubled).unwrap().nodes.len(), 61);
    }

    #[test]
    fn what_is_malformed_is_refused() {
        for (bytes, why) in [
            (&b""[..], "cut short"),
            (b"X\xff\xff\xff\xffab", "cut short"),
            (b"ccollections", "cut short"),
            (b".", "did not put"),
            (b"(0.", "did not put"),
            (b"t.", "did not begin"),
            (b"h\x05.", "recalls"),
            (b"NNa.", "no list"),
            (b"NNNs.", "no dictionary"),
            (b"}(Nu.", "without a value"),
            (b"X\x01\x00\x00\x00\xff.", "no text"),
            (b"NN\x93.", "no class"),
            (b"i", "0x69"),
        ] {
            let problem = read(bytes).unwrap_err();
            assert!(problem.contains(why), "{bytes:?}: {problem}");
        }
    }
}
