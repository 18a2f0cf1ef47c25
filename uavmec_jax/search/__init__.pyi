from .search import SearchProgress as SearchProgress
from .search import SearchResult as SearchResult
from .search import run_search as run_search
from .space import Space as Space
from .space import load_space as load_space
